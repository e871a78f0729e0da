"""The outcome of each packet, as the coloured lanes show it. Does not use Rerun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.receiver import Action, Codes, Flags
from evedrop.view.palette import Colour

BLUE: Colour = (84, 150, 250)
GREEN: Colour = (30, 128, 96)
SLATE: Colour = (70, 76, 90)
AMBER: Colour = (244, 178, 40)
RED: Colour = (206, 60, 66)
DARK: Colour = (34, 37, 44)

LEGEND = (
    "blue: state · green: innovation decoded · amber: misled by one · grey: innovation sent, discarded · red: dropped · "
    "dark: silence"
)


@dataclass(frozen=True)
class Lane:
    """The words of a lane; a word's index is its code."""

    words: tuple[str, ...]
    colours: tuple[Colour, ...]


SENT = Lane(("state", "innovation", "silent"), (BLUE, SLATE, DARK))
LEGITIMATE = Lane(("dropped", "state", "innovation", "discarded", "silent"), (RED, BLUE, GREEN, SLATE, DARK))
EAVESDROPPER = Lane((*LEGITIMATE.words, "misled"), (*LEGITIMATE.colours, AMBER))
SILENT = 4
"""Code of a slot in which nothing was sent, so that nothing could be lost."""
MISLED = 5
"""Code of the only outcome that an eavesdropper does not know itself."""


def sent(nu: Flags, any_packet: Flags | None) -> Codes:
    """Codes of the sensor's lane, (c,), from ν (c,) and whether there was a packet, (c,); None: always."""
    types = nu.astype(np.uint8)
    return types if any_packet is None else np.where(any_packet, types, np.uint8(SENT.words.index("silent")))


def received(action: Codes, nu: Flags, any_packet: Flags | None) -> Codes:
    """Codes of a receiver's lane, (c,), from its actions (c,), ν (c,) and whether there was a packet, (c,); None: always.

    They are the actions, except for silence, and for an innovation taken for the state, which misled.
    """
    misled = nu & (action == Action.STATE)
    codes: Codes = np.where(misled, np.uint8(MISLED), action)
    return codes if any_packet is None else np.where(any_packet, codes, np.uint8(SILENT))
