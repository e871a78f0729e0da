"""The coloured lanes: what became of each packet, and what each receiver knows. Does not use Rerun."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evedrop.model.receiver import DISCARDED, DROPPED, INNOVATION, MISLED, SILENT, STATE, Action, Codes
from evedrop.score.track import Track
from evedrop.show.view import palette
from evedrop.show.view.palette import Colour
from evedrop.show.view.scene import SceneSlots, Shown

_LEGEND = (
    ("state", palette.STATE),
    ("innovation decoded", palette.DECODED),
    ("misled by innovation", palette.MISLED),
    ("innovation sent, or discarded", palette.DISCARDED),
    ("dropped", palette.DROPPED),
    ("silence", palette.SILENT),
)


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
KNOWLEDGE = Lane(tuple(track.word for track in Track), palette.KNOWLEDGE)
"""What a receiver knows; a `Track` is its code."""
SILENT_CODE = np.uint8(EAVESDROPPER.words.index(SILENT))
"""Code of a slot in which nothing was sent, so that nothing could be lost."""
MISLED_CODE = np.uint8(EAVESDROPPER.words.index(MISLED))
"""Code of the only outcome that an eavesdropper does not know itself."""


def legend() -> list[tuple[str, Colour]]:
    """What the colours of all lanes stand for."""
    return [*_LEGEND]


def lane_of(shown: Shown) -> Lane:
    """The lane of a receiver."""
    return LEGITIMATE if shown.role == "legitimate" else EAVESDROPPER


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
