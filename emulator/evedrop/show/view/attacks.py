"""What an attacker does in each slot: the lanes of attacks, and their words. Does not use Rerun.

The fate of an acknowledgement is known slot by slot. A cut of links and an attack on measurements last from one slot to another.

Source: docs/view.md, attacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.acknowledgements import ACTS, AckFate
from evedrop.model.receiver import Flags
from evedrop.show.view import palette
from evedrop.show.view.lanes import Lane
from evedrop.show.view.palette import Colour
from evedrop.show.view.scene import AttackSpan, Scene, SceneSlots

_ACKS = Lane(
    ("nothing", "acknowledged", "lost", "blocked", "forged", "ignored"),
    (palette.SILENT, palette.DECODED, palette.DROPPED, palette.DISCARDED, palette.MISLED, palette.DISCARDED),
)
"""What became of acknowledgements; an `AckFate` is its code."""
LASTING = "attack"
"""The name of the lane of attacks that last, which a view shows in words."""
NO_ATTACK = " "
"""The word of a lane where nothing is attacked."""


def lane_count(scene: Scene) -> int:
    """The number of lanes of acknowledgements and attacks."""
    return (scene.acknowledgements is not None) + bool(scene.spans)


@final
class Attacks:
    """The attacks on a run, whose slots come in order."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        ends = [(k, begins, span) for span in scene.spans for k, begins in ((span.first, True), (span.stop, False))]
        words, bounds, parts, now = {NO_ATTACK: 0}, [0], [0], list[AttackSpan]()
        for k, begins, span in sorted(ends, key=lambda end: end[:2]):
            now.append(span) if begins else now.remove(span)
            bounds.append(k)
            parts.append(words.setdefault(_together(now), len(words)))
        self._bounds: NDArray[np.int64] = np.array(bounds, np.int64)
        self._words, self._of_part = tuple(words), np.array(parts, np.int64)
        acks = scene.acknowledgements
        self._attacker = None if acks is None else acks.attacker
        self._attack = None if acks is None or acks.attacker is None else acks.attack
        self._possible = () if acks is None else ACTS[acks.attack]
        self._done = dict.fromkeys(self._possible, 0)

    def ink(self, act: AckFate) -> Colour:
        """The colour of an attacker's act: that of the eavesdropper that it serves, otherwise a tone."""
        return _ACKS.colours[act] if self._attacker is None else self._scene.colours[self._attacker]

    def words(self, act: AckFate) -> str:
        """What an attacker did to an acknowledgement, such as "blocked by jammer"."""
        by = {None: "", "hijack": f" in favour of {self._attacker}"}.get(self._attack, f" by {self._attacker}")
        return _ACKS.words[act] + by

    @property
    def title(self) -> str:
        """What the colours of the lane of acknowledgements mean; empty without that lane."""
        if self._scene.acknowledgements is None:
            return ""
        tones = {AckFate.FORGED: "sand"}
        acts = [
            f"{tones.get(act, 'brown') if self._attacker is None else f'in the colour of {self._attacker}'}: {_ACKS.words[act]}"
            for act in self._possible
        ]
        return ", ".join(("   acknowledged   pale: yes", *acts))

    def lanes(self) -> list[tuple[str, Lane]]:
        """The lanes, each with its name: acknowledgements, then attacks that last."""
        lanes = []
        if self._scene.acknowledgements is not None:
            own = {int(act): self.ink(act) for act in self._possible}
            colours = tuple(own.get(code, colour) for code, colour in enumerate(_ACKS.colours))
            lanes.append(("acknowledged", Lane(_ACKS.words, colours)))
        if self._scene.spans:
            tones = [palette.SILENT, *(palette.MISLED for _ in self._words[1:])]
            lanes.append((LASTING, Lane(self._words, tuple(tones))))
        return lanes

    def codes(self, slots: SceneSlots) -> list[NDArray[np.integer]]:
        """The codes of the lanes, (c,) each."""
        codes: list[NDArray[np.integer]] = [] if slots.acknowledged is None else [slots.acknowledged]
        return [*codes, self._lasting(slots.numbers)] if self._scene.spans else codes

    def _lasting(self, k: NDArray[np.int64]) -> NDArray[np.int64]:
        codes: NDArray[np.int64] = self._of_part[np.searchsorted(self._bounds, k, side="right") - 1]
        return codes

    def acts(self, slots: SceneSlots) -> list[tuple[Colour, Flags]]:
        """The attacker's acts on acknowledgements: the colour of each kind, and in which slots it was, (c,)."""
        codes = slots.acknowledged
        return [] if codes is None else [(self.ink(act), codes == act) for act in self._possible]

    @property
    def possible(self) -> list[tuple[AckFate, str]]:
        """The acts on acknowledgements that the attack can consist of, and what they do, in words."""
        return [(act, self.words(act)) for act in self._possible]

    @property
    def kinds(self) -> list[tuple[str, Colour]]:
        """What is attacked, in words, and the colour of each kind: attacks that last, then those on acknowledgements."""
        lasting = [(word, palette.MISLED) for word in self._words[1:]]
        return lasting + [(f"acknowledgement {self.words(act)}", self.ink(act)) for act in self._possible]

    def flags(self, slots: SceneSlots) -> list[Flags]:
        """In which slots each kind of attack is, (c,)."""
        lasting = self._lasting(slots.numbers)
        return [lasting == code for code in range(1, len(self._words))] + [flags for _, flags in self.acts(slots)]

    def texts(self, slots: SceneSlots, at: NDArray[np.intp]) -> list[str]:
        """What the attacker does in each of some slots, and how often it has; empty where it has done nothing.

        at: their offsets among the slots. Slots come in order.
        """
        lasting = [self._words[code].strip() for code in self._lasting(slots.numbers[at]).tolist()]
        if slots.acknowledged is None:
            return lasting
        texts = [[text] if text else [] for text in lasting]
        for act in self._possible:
            flags = slots.acknowledged == act
            counts = self._done[act] + np.cumsum(flags)
            self._done[act] = int(counts[-1])
            words = self.words(act)
            for text, now, count in zip(texts, flags[at].tolist(), counts[at].tolist(), strict=True):
                if now:
                    text.append(f"acknowledgement {words}, {count} so far")
                elif count:
                    text.append(f"{count} acknowledgement{'s' * (count > 1)} {words} so far")
        return [" · ".join(text) for text in texts]


def _together(spans: Sequence[AttackSpan]) -> str:
    """Attacks at the same time in words, such as "cut off: legitimate, smart"."""
    texts, cut = [span.text for span in spans if span.text], [span.receiver for span in spans if span.receiver]
    return ", ".join([*texts, f"cut off: {', '.join(cut)}"] if cut else texts) or NO_ATTACK


def cut_off(scene: Scene, receiver: str, k: NDArray[np.int64]) -> Flags:
    """Whether a receiver's link is cut in slots k, (c,)."""
    cut = np.zeros(len(k), np.bool_)
    for span in scene.spans:
        if span.receiver == receiver:
            cut |= (span.first <= k) & (k < span.stop)
    return cut
