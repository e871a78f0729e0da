"""What became of each packet, as the coloured lanes show it. No Rerun in here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.model.receiver import Action, Codes, Flags
from emulator.view.palette import Colour

BLUE: Colour = (84, 150, 250)
GREEN: Colour = (30, 128, 96)
SLATE: Colour = (70, 76, 90)
AMBER: Colour = (244, 178, 40)
RED: Colour = (206, 60, 66)

LEGEND = (
    "blue: state · green: innovation decoded · amber: misled by one · grey: innovation sent, discarded · red: dropped"
)


@dataclass(frozen=True)
class Lane:
    """What can happen in a lane; the index of a word is its code."""

    words: tuple[str, ...]
    colours: tuple[Colour, ...]


SENT = Lane(("state", "innovation"), (BLUE, SLATE))
LEGITIMATE = Lane(("dropped", "state", "innovation", "discarded"), (RED, BLUE, GREEN, SLATE))
EAVESDROPPER = Lane(
    ("dropped", "state", "innovation", "discarded", "misled"),
    (RED, BLUE, GREEN, SLATE, AMBER),
)
MISLED = 4
"""Code of the one thing an eavesdropper does not know itself."""


def sent(nu: Flags) -> Codes:
    """Codes of the lane of what was sent, (c,), from ν (c,)."""
    return nu.astype(np.uint8)


def received(action: Codes, nu: Flags) -> Codes:
    """Codes of a receiver's lane, (c,), from its actions (c,) and ν (c,).

    They are the actions, but for an innovation taken for the state: that one was misled.
    """
    misled = nu & (action == Action.STATE)
    codes: Codes = np.where(misled, np.uint8(MISLED), action)
    return codes
