"""How well everybody did: sums over trials in every slot, over slots in every trial, and the summary made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats
from emulator.model.receiver import Action, Codes, Flags
from emulator.runs.watched import Watched

WINDOWS = 8
"""The slots k ≥ 1 are judged in so many windows, of equal length up to one slot."""


@dataclass
class SlotSums:
    """Sums over trials, slot by slot, (c,) each. Final."""

    trials: Floats
    error: Floats
    """Squared error, or tr of the actual covariance in a study that simulates covariances alone."""
    error_squared: Floats
    trace: Floats
    """Believed tr P."""
    trace_squared: Floats
    received: Floats
    used: Floats

    @classmethod
    def zero(cls, slots: int) -> SlotSums:
        """Sums of no trials, to add to."""
        return cls(*(np.zeros(slots) for _ in fields(cls)))

    def add(self, first: int, other: SlotSums) -> None:
        """Add the sums of further trials over some slots from `first` on."""
        rows = slice(first, first + len(other.error))
        for one in fields(self):
            getattr(self, one.name)[rows] += getattr(other, one.name)

    def measured(self) -> SlotSums:
        """The slots that any trial came to: all but the last ones of a run cut short."""
        rows = slice(0, int(np.count_nonzero(self.trials)))
        return SlotSums(*(getattr(self, one.name)[rows] for one in fields(self)))


def squared_errors(x: Floats, x_hat: Floats) -> Floats:
    """|x − x̂|² of every slot and trial, (c, R), from (c, n, R)."""
    error = x - x_hat
    error *= error
    squared: Floats = error.sum(axis=1)
    return squared


def slot_sums(error: Floats, action: Codes, trace: Floats | None = None) -> SlotSums:
    """The sums of some slots, from error (c, R), action (c, R), and the sums of tr P and of its square, (c, 2).

    Without the latter the error is tr P itself.
    """
    count, trials = error.shape
    errors, squares = error.sum(axis=1), (error * error).sum(axis=1)
    received = np.count_nonzero(action != Action.LOST, axis=1).astype(np.float64)
    discarded = np.count_nonzero(action == Action.DISCARDED, axis=1)
    return SlotSums(
        trials=np.full(count, float(trials)),
        error=errors,
        error_squared=squares,
        trace=errors if trace is None else trace[:, 0],
        trace_squared=squares if trace is None else trace[:, 1],
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
    """Of the whole run."""
    trials: int
    watched: Watched = field(default_factory=lambda: Watched((), 0))
    """What expectations ask of the receiver."""
    done: int = 0
    """Slots that all trials have."""
    offered: int = 0
    """Packets: slots times trials."""
    error: float = 0.0
    trace: float = 0.0
    expected_trace: float = 0.0
    received: int = 0
    used: int = 0
    unexplained: int = 0
    """Packets whose fate in the journal is not the receiver's."""
    lost: dict[str, int] = field(default_factory=dict)
    window_errors: Floats = field(init=False)
    """Sum of errors of each window and trial, (WINDOWS + 1, R); the last row is slot 0, which is in no window."""

    def __post_init__(self) -> None:
        self.window_errors = np.zeros((WINDOWS + 1, self.trials))

    def add(self, first: int, error: Floats, sums: SlotSums, expected: Floats) -> None:
        """Take c slots: their errors (c, R), sums, and expected trace (c,)."""
        count = len(error)
        self.done += count
        self.offered += count * self.trials
        self.error += float(sums.error.sum())
        self.trace += float(sums.trace.sum())
        self.expected_trace += float(expected.sum()) * self.trials
        self.received += int(sums.received.sum())
        self.used += int(sums.used.sum())
        windows = window_of(np.arange(first, first + count), self.slots)
        for window in range(-1, WINDOWS):
            inside = np.flatnonzero(windows == window)
            if inside.size:
                self.window_errors[window] += error[inside[0] : inside[-1] + 1].sum(axis=0)

    def account(self, delivered: Flags, action: Codes, lost: Mapping[str, NDArray[np.uint32]]) -> None:
        """Hold the journal, delivered (c, R) and reason → lost (c,), against what the receiver did, (c, R)."""
        self.unexplained += int(np.count_nonzero(delivered != (action != Action.LOST)))
        for reason, counts in lost.items():
            self.lost[reason] = self.lost.get(reason, 0) + int(counts.sum())

    @property
    def figures(self) -> dict[str, float]:
        """The receiver's figures: means over slots and trials."""
        offered = max(1, self.offered)
        return {
            "mean_squared_error": self.error / offered,
            "mean_trace_covariance": self.trace / offered,
            "expected_trace_covariance": self.expected_trace / offered,
            "received_fraction": self.received / offered,
            "used_fraction": self.used / offered,
        }

    @property
    def link(self) -> dict[str, int]:
        """The link's account: every packet offered is delivered or lost for a reason."""
        lost = sum(self.lost.values())
        missing = abs(self.offered - self.received - lost)
        return {
            "offered": self.offered,
            "delivered": self.received,
            "lost": lost,
            "unexplained": max(missing, self.unexplained),
        }


def window_means(tally: Tally) -> Floats:
    """Mean squared error of each window and trial, (WINDOWS, R); NaN for windows without slots."""
    lengths = np.bincount(window_of(np.arange(1, tally.slots), tally.slots), minlength=WINDOWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        means: Floats = tally.window_errors[:WINDOWS] / lengths[:, None]
    return means


def trial_means(tally: Tally) -> Floats:
    """Mean error of every trial over its slots, (R,)."""
    means: Floats = tally.window_errors.sum(axis=0) / tally.slots
    return means


def merged(tallies: Mapping[int, Tally]) -> Tally:
    """One tally of several disjoint sets of trials, in the order of their keys."""
    parts = [tallies[key] for key in sorted(tallies)]
    total = Tally(parts[0].slots, sum(part.trials for part in parts))
    total.watched = Watched.of([part.watched for part in parts])
    total.done = min(part.done for part in parts)
    for part in parts:
        for name in ("offered", "error", "trace", "expected_trace", "received", "used", "unexplained"):
            setattr(total, name, getattr(total, name) + getattr(part, name))
        for reason, count in part.lost.items():
            total.lost[reason] = total.lost.get(reason, 0) + count
    total.window_errors = np.concatenate([part.window_errors for part in parts], axis=1)
    return total
