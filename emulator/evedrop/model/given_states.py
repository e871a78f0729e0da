"""States that are given, from a recording or a program, in place of a simulated process.

All trials share them: they differ in what is drawn for links, schedules, noise and coins.

Source: docs/mathematics.md, given states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np

from evedrop.model.process import Floats, Process, product

LARGEST = 1e100
"""The largest given state, as a deviation from the reference: the square, summed over trials, stays within double precision."""


def deviations(levels: Floats, reference: Floats) -> Floats:
    """The deviations x (…, n) of levels (…, n) from the public reference (n,).

    They are rounded so that the levels x + reference have exactly these deviations again: tables hold such levels.
    """
    return ((levels - reference) + reference) - reference


def recorded(states: Floats) -> Callable[[range], Floats]:
    """Returns the rows of some slots of states that were recorded, (slots, n)."""
    return lambda slots: states[slots.start : slots.stop]


@final
class GivenStates:
    """The given states of a batch, and the predictions A x_{k−1} that innovations refer to. Must be read in order.

    take: returns the deviations of the next slots, (c, n).
    """

    def __init__(self, process: Process, take: Callable[[range], Floats], trials: int) -> None:
        self._A, self._take, self._trials = process.A, take, trials
        self._last = np.zeros((process.n, 1))

    def advance(self, slots: range) -> tuple[Floats, Floats]:
        """The states of the next slots and the predictions A x_{k−1} of each, (c, n, R); the prediction of slot 0 is 0."""
        x = self._take(slots)[:, :, None]
        predicted = product(self._A, np.concatenate([self._last[None], x[:-1]]))
        self._last = x[-1]
        return np.repeat(x, self._trials, axis=2), np.repeat(predicted, self._trials, axis=2)
