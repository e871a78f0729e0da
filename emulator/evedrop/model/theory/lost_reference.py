"""The error of a receiver that lacks the reference of later packets, and the unencrypted states that end its growth.

Source: docs/mathematics.md, flipped acknowledgements.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from evedrop.model.process import Process
from evedrop.model.theory.covariances import radius

_LARGEST_EXPONENT = 700.0  # of a double


class LostReference(NamedTuple):
    """The growth of the expected error of a receiver that lacks the reference."""

    growth: float
    """The factor from slot to slot, or from one phase of unencrypted states to the next; from 1 on the error has no bound."""
    remedy: str
    """What must be changed for a factor below 1, in words that follow "unless"."""


def growth_by_coin(process: Process, plain: float, received: float) -> float:
    """The factor for each slot: ρ² times the probability of not receiving an unencrypted state.

    plain: the probability α that a packet contains the state; received: that it arrives.
    """
    return radius(process) ** 2 * (1.0 - plain * received)


def growth_by_phases(process: Process, coded: float, received: float, acknowledged: tuple[float, float]) -> float:
    """The factor from one phase of unencrypted states, which ends with an acknowledgement, to the next; inf if it is unbounded.

    coded: the acknowledged coded packets between two phases. acknowledged: the probabilities that a packet is acknowledged and
    was heard by the receiver, and that it is acknowledged and was not heard.
    """
    between, in_phase = _growths(process, received, acknowledged)
    if in_phase == 0.0:
        return 0.0
    if not (math.isfinite(between) and math.isfinite(in_phase) and math.isfinite(coded)):
        return math.inf
    exponent = coded * math.log(between) + math.log(in_phase)
    return math.exp(exponent) if exponent < _LARGEST_EXPONENT else math.inf


def most_coded(process: Process, received: float, acknowledged: tuple[float, float]) -> float:
    """The most acknowledged coded packets between two phases with a factor below 1; −1 if even none is too many."""
    between, in_phase = _growths(process, received, acknowledged)
    if not in_phase < 1.0:
        return -1.0
    if in_phase == 0.0 or between <= 1.0:
        return math.inf
    return math.ceil(-math.log(in_phase) / math.log(between)) - 1.0


def _growths(process: Process, received: float, acknowledged: tuple[float, float]) -> tuple[float, float]:
    """The factors of the slots up to the acknowledgement of one coded packet, and of a phase whose states are not received."""
    square, missed = radius(process) ** 2, acknowledged[1]
    arrives = sum(acknowledged)
    return _growth_until(square, arrives, 1.0 - arrives), _growth_until(square, missed, 1.0 - received - missed)


def _growth_until(square: float, ends: float, goes_on: float) -> float:
    """The sum over j of square^{j+1} times the probability that the growth ends after j slots; inf if it has no bound."""
    rest = 1.0 - square * goes_on
    return square * ends / rest if rest > 0.0 else math.inf
