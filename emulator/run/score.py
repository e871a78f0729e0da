"""How well everybody did: sums over trials in every slot, over slots in every trial, and the summary made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats
from emulator.model.receiver import Action
from emulator.run.joined import ReceiverSlots, Slots

WINDOWS = 8
"""The slots k ≥ 1 are judged in so many windows, of equal length up to one slot."""


@dataclass
class SlotSums:
    """Sums over trials, slot by slot, (c,) each. Final."""

    trials: int
    squared_error: Floats
    squared_error_squared: Floats
    trace: Floats
    """Believed tr P."""
    trace_squared: Floats
    received: Floats
    used: Floats

    @classmethod
    def zero(cls, slots: int) -> SlotSums:
        """Sums of no trials, to add to."""
        return cls(0, *(np.zeros(slots) for _ in range(6)))

    def add(self, first: int, other: SlotSums) -> None:
        """Add the sums of further trials over some slots from `first` on; their last slots complete the trials."""
        rows = slice(first, first + len(other.squared_error))
        self.squared_error[rows] += other.squared_error
        self.squared_error_squared[rows] += other.squared_error_squared
        self.trace[rows] += other.trace
        self.trace_squared[rows] += other.trace_squared
        self.received[rows] += other.received
        self.used[rows] += other.used
        if rows.stop == len(self.squared_error):
            self.trials += other.trials


def squared_errors(slots: Slots, receiver: ReceiverSlots) -> Floats:
    """|x − x̂|² of every slot and trial, (c, R)."""
    error = slots.x - receiver.x_hat
    error *= error
    squared: Floats = error.sum(axis=1)
    return squared


def slot_sums(receiver: ReceiverSlots, squared_error: Floats) -> SlotSums:
    """The sums of some slots, from squared_error (c, R)."""
    received = np.count_nonzero(receiver.action != Action.LOST, axis=1).astype(np.float64)
    discarded = np.count_nonzero(receiver.action == Action.DISCARDED, axis=1)
    return SlotSums(
        trials=squared_error.shape[1],
        squared_error=squared_error.sum(axis=1),
        squared_error_squared=(squared_error * squared_error).sum(axis=1),
        trace=receiver.trace[:, 0],
        trace_squared=receiver.trace[:, 1],
        received=received,
        used=received - discarded,
    )


def window_of(k: NDArray[np.intp], slots: int) -> NDArray[np.intp]:
    """The window each slot k ≥ 1 belongs to, of a run of `slots` slots; −1 for k = 0."""
    return np.where(k == 0, -1, (k - 1) * WINDOWS // max(slots - 1, 1))


@dataclass
class Tally:
    """One receiver's totals over a run. Final."""

    slots: int
    trials: int
    done: int = 0
    squared_error: float = 0.0
    trace: float = 0.0
    expected_trace: float = 0.0
    received: int = 0
    used: int = 0
    passed_on: int = 0
    unexplained: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    window_errors: Floats = field(init=False)
    """Sum of squared errors of each window and trial, (WINDOWS, R)."""

    def __post_init__(self) -> None:
        self.window_errors = np.zeros((WINDOWS, self.trials))

    def add(self, first: int, receiver: ReceiverSlots, squared_error: Floats, sums: SlotSums, expected: Floats) -> None:
        """Take c slots: their squared_error (c, R), sums, and expected trace (c,)."""
        count = len(squared_error)
        self.done += count
        self.squared_error += float(sums.squared_error.sum())
        self.trace += float(sums.trace.sum())
        self.expected_trace += float(expected.sum())
        self.received += int(sums.received.sum())
        self.used += int(sums.used.sum())
        self.passed_on += int(np.count_nonzero(receiver.delivered))
        self.unexplained += int(np.count_nonzero(receiver.delivered != (receiver.action != Action.LOST)))
        for reason, counts in receiver.lost.items():
            self.lost[reason] = self.lost.get(reason, 0) + int(counts.sum())
        windows = window_of(np.arange(first, first + count), self.slots)
        for window in range(WINDOWS):
            inside = np.flatnonzero(windows == window)
            if inside.size:
                self.window_errors[window] += squared_error[inside[0] : inside[-1] + 1].sum(axis=0)

    @property
    def figures(self) -> dict[str, float]:
        """The receiver's figures: means over slots and trials."""
        offered = max(1, self.done * self.trials)
        return {
            "mean_squared_error": self.squared_error / offered,
            "mean_trace_covariance": self.trace / offered,
            "expected_trace_covariance": self.expected_trace / max(1, self.done),
            "received_fraction": self.received / offered,
            "used_fraction": self.used / offered,
        }

    @property
    def link(self) -> dict[str, int]:
        """The link's account: every packet offered is delivered or lost for a reason."""
        offered, lost = self.done * self.trials, sum(self.lost.values())
        missing = abs(offered - self.received - lost)
        return {
            "offered": offered,
            "delivered": self.received,
            "lost": lost,
            "unexplained": max(missing, self.unexplained),
        }


def window_means(tally: Tally) -> Floats:
    """Mean squared error of each window and trial, (WINDOWS, R); NaN for windows without slots."""
    lengths = np.bincount(window_of(np.arange(1, tally.slots), tally.slots), minlength=WINDOWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        means: Floats = tally.window_errors / lengths[:, None]
    return means


def merged(tallies: Mapping[int, Tally]) -> Tally:
    """One tally of several disjoint sets of trials, in the order of their keys."""
    parts = [tallies[key] for key in sorted(tallies)]
    total = Tally(parts[0].slots, sum(part.trials for part in parts))
    total.done = parts[0].done
    total.expected_trace = parts[0].expected_trace
    for part in parts:
        total.squared_error += part.squared_error
        total.trace += part.trace
        total.received += part.received
        total.used += part.used
        total.passed_on += part.passed_on
        total.unexplained += part.unexplained
        for reason, count in part.lost.items():
            total.lost[reason] = total.lost.get(reason, 0) + count
    total.window_errors = np.concatenate([part.window_errors for part in parts], axis=1)
    return total
