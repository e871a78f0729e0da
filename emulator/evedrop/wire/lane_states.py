"""The fates of a link's messages in a time step, as its coloured lane shows them. Does not use Rerun.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

from enum import Enum

from evedrop.show.view import palette
from evedrop.show.view.lanes import Lane
from evedrop.show.view.palette import Colour
from evedrop.wire.plan import WirePlan
from evedrop.wire.record import WireFate
from evedrop.wire.step_counts import DELIVERED, OUTCOMES, UNDERWAY, Counts


class LaneState(Enum):
    """A word for a step of a lane, its colour, and the colour's name."""

    QUIET = ("no message", palette.SILENT, "dark")
    DELIVERED = ("all delivered", palette.STATE, "blue")
    SOME = ("some lost", palette.MISLED, "amber")
    MOST = ("most lost", palette.DROPPED, "red")
    CUT = ("cut", palette.TRUTH, "white")
    FULL = ("queue full", palette.DISCARDED, "purple")
    OWN = ("not by the link", palette.DECODED, "green")

    def __init__(self, word: str, colour: Colour, name_of_colour: str) -> None:
        self.word = word
        self.colour = colour
        self.name_of_colour = name_of_colour


LANE = Lane(tuple(state.word for state in LaneState), tuple(state.colour for state in LaneState))
"""The lane of a link."""


def state_of(counts: Counts) -> LaneState:
    """The state of a link; counts: messages by outcome, (outcomes,). The most frequent reason for a loss decides.

    Messages that were still underway when the wire ended do not count.
    """
    ended = counts.copy()
    ended[UNDERWAY] = 0
    reasons = ended.copy()
    reasons[DELIVERED] = 0
    if not reasons.any():
        return LaneState.DELIVERED if counts[DELIVERED] else LaneState.QUIET
    reason = OUTCOMES[int(reasons.argmax())]
    if reason is WireFate.CUT:
        return LaneState.CUT
    if reason is WireFate.OVERFLOW:
        return LaneState.FULL
    return loss_state_of(ended) if reason.emulated else LaneState.OWN


def loss_state_of(counts: Counts) -> LaneState:
    """How much of a link's messages was lost, for whatever reason; counts as for `state_of`."""
    heard, delivered = int(counts.sum()), int(counts[DELIVERED])
    if not heard:
        return LaneState.QUIET
    if delivered == heard:
        return LaneState.DELIVERED
    return LaneState.SOME if 2 * delivered > heard else LaneState.MOST


def legend(plan: WirePlan) -> str:
    """The legend of the lanes, with what this wire's file can cause."""
    states = [LaneState.DELIVERED, LaneState.SOME, LaneState.MOST, LaneState.CUT]
    settings = [*(link.settings for link in plan.links), *(event.settings or {} for event in plan.events)]
    if any(one.get("rate") for one in settings):
        states.append(LaneState.FULL)
    return " · ".join(f"{state.name_of_colour}: {state.word}" for state in states)
