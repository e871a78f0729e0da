"""The coloured lanes: what became of each packet, and what each receiver knows. Does not use Rerun.

A receiver is synchronised, uncertain or overconfident in each slot.

Source: docs/view.md, who knows what.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import DISCARDED, DROPPED, INNOVATION, MISLED, SILENT, STATE, Action, Codes
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Scheme
from evedrop.score.after_start import leading_states
from evedrop.score.synchronisation import FACTOR, Synchronisation, synchronisation_of
from evedrop.score.verdict import distance_text
from evedrop.show.view import palette
from evedrop.show.view.palette import Colour
from evedrop.show.view.scene import Scene, SceneSlots, Shown


@dataclass(frozen=True)
class Lane:
    """The words of a lane and their colours; a word's index is its code."""

    words: tuple[str, ...]
    colours: tuple[Colour, ...]

    def pixels(self, codes: Codes) -> NDArray[np.uint8]:
        """The colours of codes (…), (…, 3)."""
        return np.array(self.colours, np.uint8)[codes]

    def legend(self, codes: Collection[int] | None = None) -> list[tuple[str, str]]:
        """The words of some codes, or of all, each with its colour as matplotlib and HTML write it."""
        some = range(len(self.words)) if codes is None else sorted(codes)
        return [(self.words[code], palette.hexadecimal(self.colours[code])) for code in some]


SENT = Lane((STATE, INNOVATION, SILENT), (palette.STATE, palette.DISCARDED, palette.SILENT))
LEGITIMATE = Lane(
    (DROPPED, STATE, INNOVATION, DISCARDED, SILENT),
    (palette.DROPPED, palette.STATE, palette.DECODED, palette.DISCARDED, palette.SILENT),
)
EAVESDROPPER = Lane((*LEGITIMATE.words, MISLED), (*LEGITIMATE.colours, palette.MISLED))
KNOWLEDGE = Lane(tuple(status.word for status in Synchronisation), palette.KNOWLEDGE)
"""What the legitimate estimator knows; a `Synchronisation` is its code."""
SPIED = Lane(KNOWLEDGE.words, palette.SPIED)
"""What an eavesdropper knows, with the same codes."""
SILENT_CODE = np.uint8(EAVESDROPPER.words.index(SILENT))
"""Code of a slot in which nothing was sent, so that nothing could be lost."""
MISLED_CODE = np.uint8(EAVESDROPPER.words.index(MISLED))
"""Code of the only outcome that an eavesdropper does not know itself."""


READ = "read"
"""What an eavesdropper did with a packet that it did not use as the state, where the scheme sends no innovations."""


def scheme_of(scene: Scene) -> type[Scheme]:
    """The scheme of a run, or the base class of all if it is not built in."""
    name = scene.receivers[0].strategy
    return SCHEMES[name] if name in SCHEMES.names else Scheme


def legend(scene: Scene) -> list[tuple[str, Colour]]:
    """What the colours of the run's lanes stand for, in the words of its scheme, and without what cannot happen in it."""
    scheme, spied = scheme_of(scene), len(scene.receivers) > 1
    state, *others = scheme.sent_words
    entries = [(state, palette.STATE)]
    if INNOVATION in others:
        entries.append((f"{INNOVATION} decoded", palette.DECODED))
    elif spied:
        entries.append((READ, palette.DECODED))
    for other in others:
        if spied:
            entries.append((f"misled by {other}", palette.MISLED))
        entries.append((f"{other} sent, or discarded", palette.DISCARDED))
    if spied and not others:
        entries.append((DISCARDED, palette.DISCARDED))
    entries.append((DROPPED, palette.DROPPED))
    if scheme.may_be_silent or scheme is Scheme:
        entries.append(("silence", palette.SILENT))
    return entries


def sent_lane(scene: Scene) -> Lane:
    """The sensor's lane, in the words of the run's scheme."""
    words = scheme_of(scene).sent_words
    return Lane((words[0], words[1] if len(words) > 1 else INNOVATION, SILENT), SENT.colours)


def lane_of(shown: Shown, scene: Scene) -> Lane:
    """The lane of a receiver, in the words of the run's scheme.

    Without innovations, whatever the legitimate estimator could use is what the sensor sent.
    """
    words = scheme_of(scene).sent_words
    legitimate = shown.role == "legitimate"
    lane = LEGITIMATE if legitimate else EAVESDROPPER
    names, colours = [*lane.words], [*lane.colours]
    if INNOVATION not in words:
        names[Action.INNOVATION] = words[0] if legitimate else READ
        if legitimate:
            names[Action.STATE], colours[Action.INNOVATION] = words[0], palette.STATE
    return Lane(tuple(names), tuple(colours))


def knowledge_lane(role: str) -> Lane:
    """The lane of what a receiver of this role knows."""
    return KNOWLEDGE if role == "legitimate" else SPIED


def sent(slots: SceneSlots) -> Codes:
    """Codes of the sensor's lane, (c,): the packets' types, or silence."""
    types = slots.nu.astype(np.uint8)
    return types if slots.sent is None else np.where(slots.sent, types, np.uint8(SENT.words.index(SILENT)))


def received(shown: Shown, slots: SceneSlots) -> Codes:
    """Codes of a receiver's lane, (c,).

    They are its actions, except for silence, and for an innovation that an eavesdropper took for the state, which misled. The
    legitimate estimator knows every type, and is never misled.
    """
    action = slots.peers[shown.name].action
    codes: Codes = action
    if shown.role != "legitimate":
        codes = np.where(slots.nu & (action == Action.STATE), MISLED_CODE, action)
    return codes if slots.sent is None else np.where(slots.sent, codes, SILENT_CODE)


def knowledge(scene: Scene, x: Floats, x_hat: Floats, P: Floats) -> Codes:
    """Codes of the lane `KNOWLEDGE`, (c,), by `synchronisation_of`.

    x, x_hat, P: true states, estimates and reported covariances of one trial, (c, n), (c, n), (c, n, n).
    """
    with np.errstate(all="ignore"):
        squared, trace = squares(x - x_hat), np.einsum("cii->c", P)
    return synchronisation_of(squared, trace, scene.noise)


def squares(vectors: Floats) -> Floats:
    """The sums of squares of vectors (c, n), (c,); numpy's sum over few numbers takes several times as long."""
    squares: Floats = np.einsum("ci,ci->c", vectors, vectors)
    return squares


@final
class ErrorDistance:
    """How far estimates are from the truth, as numbers with their unit.

    They count the first states as far as they have the unit of the first, such as the two coordinates of a place in metres and
    not the speeds that follow. Without units they count all states.
    """

    def __init__(self, scene: Scene) -> None:
        self._count, self._unit = leading_states(scene.units, scene.n), scene.unit
        self._near = math.sqrt(FACTOR * scene.noise)
        self._nothing = math.sqrt(scene.noise) * _NOTHING
        self._plain_from, self._suffix = max(self._nothing, _LEAST_PLAIN), f" {self._unit}".rstrip()
        first = math.floor(math.log10(self._near)) + 1
        self._steps = np.array([self._near, *(10.0**decade for decade in range(first, first + _DECADES))])

    def of(self, x: Floats, x_hat: Floats) -> Floats:
        """The distances of estimates from true states, (c,)."""
        distances: Floats = np.sqrt(squares((x - x_hat)[:, : self._count]))
        return distances

    def text(self, distance: float) -> str:
        """A distance with two digits and its unit, such as "0.32 m"; "0 m" if it is less than a thousandth of √(tr Q)."""
        if self._plain_from <= distance < _LARGEST_PLAIN:  # as below, in a fraction of the time: a view has thousands
            digits = f"{distance:.2g}"
            return (digits if distance < _LARGE else f"{float(digits):,.0f}") + self._suffix
        return self._text(0.0 if distance < self._nothing else distance)

    @property
    def bounds(self) -> list[str]:
        """Bounds of distances in words, such as "<0.47 m", ">0.47 m", ">1 m", ">10 m"; the first is that of synchronisation."""
        return [f"<{self._text(self._near)}", *(f">{self._text(step)}" for step in self._steps)]

    def bounds_of(self, distances: Floats) -> NDArray[np.int64]:
        """Which of `bounds` each distance has, (c,): the largest that it exceeds."""
        reached: NDArray[np.int64] = np.searchsorted(self._steps, np.nan_to_num(distances, nan=np.inf), side="left")
        return reached

    def _text(self, distance: float) -> str:
        if not math.isfinite(distance):
            return "everything"
        return distance_text(distance, self._unit)


_DECADES = 9
_LEAST_PLAIN, _LARGE, _LARGEST_PLAIN = 1e-3, 99.0, 9e5  # numbers of which two digits are written without a power of ten
_NOTHING = 1e-3  # the fraction of √(tr Q), the distance of one step, below which a distance is only that of rounding


@final
class KnowledgeLane:
    """The lane of one receiver: its colour is what the receiver knows, its words are a bound of how far off it is.

    A word stands at the start of a stretch and names the largest distance so far, so that it does not flicker. A stretch shorter
    than its word has none, because the word would be cut: while a stretch is that short, so is every one at the present.
    """

    def __init__(self, shown: Shown, distance: ErrorDistance) -> None:
        self._distance, self._bounds = distance, distance.bounds
        inks = knowledge_lane(shown.role).colours
        kinds = [(status, bound) for status in Synchronisation for bound in ("", *self._bounds)]
        self.lane = Lane(
            tuple(f"{status.word} {bound}".rstrip() for status, bound in kinds),
            tuple(inks[status] for status, _ in kinds),
        )
        self.labels = [bound or " " for _, bound in kinds]
        """What the lane shows for each of its words."""
        self._widths = np.array([*map(len, self._bounds)])
        self._level, self._bound = -1, 0  # of the last slot
        self._since, self._worded = 0, False  # the stretch of the last slot, and whether it has its word

    def changes(self, first: int, levels: Codes, distances: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Slots and the codes of `lane` from there on, for the next slots, which begin with `first`; levels, distances: (c,).

        A slot may come twice, and slots before `first` may come: the word of a stretch then takes the place of its blank.
        """
        level, bound = levels.astype(np.int64), self._distance.bounds_of(distances)
        starts = np.diff(level, prepend=self._level) != 0
        stretch, each = np.cumsum(starts), len(self._bounds)
        carried = np.where(stretch == 0, self._bound, 0)
        bound = np.maximum.accumulate(stretch * each + np.maximum(bound, carried)) - stretch * each
        changed = starts | (np.diff(bound, prepend=self._bound) != 0)
        changed[:1] = True
        edges = np.flatnonzero(changed)
        stretch, starts, bound, blank = stretch[edges], starts[edges], bound[edges], (1 + each) * level[edges]
        begin, end = first + edges, first + np.append(edges, len(level))[1:]
        # Most stretches have one bound from start to end. The first began, and the last may end, in another call.
        simple = np.bincount(stretch, minlength=1) == 1
        simple[[0, -1]] = False
        whole = simple[stretch]
        worded = end - begin > self._widths[bound]
        k, codes = list[int](), list[int]()
        parts = (values[~whole].tolist() for values in (begin, end, starts, blank, bound))
        for start, stop, begins, code, now in zip(*parts, strict=True):
            if begins or (self._worded and now != self._bound):
                self._since, self._worded = start, False
                k.append(start)
                codes.append(code)
            self._bound = now
            if not self._worded and stop - self._since > self._widths[now]:
                self._worded = True
                k.append(self._since)
                codes.append(code + 1 + now)
        self._level = int(level[-1]) if len(level) else self._level
        slots = np.append(begin[whole], np.array(k, np.int64))
        order = np.argsort(slots, kind="stable")
        words = np.append((blank + np.where(worded, 1 + bound, 0))[whole], np.array(codes, np.int64))
        return slots[order], words[order]
