"""What expectations need of a receiver besides its totals: sums over some slots, and when it was in step, trial by trial.

Memory: a number for each trial and expectation. A trial's numbers are added slot by slot, so they have the same bits
however its slots and the other trials were divided, live and in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Codes
from evedrop.scenario import ExpectTable, Scenario

IN_STEP = "in_step"
_NEVER = -1.0
_TRACE = "mean_trace_covariance"
_LATE = {"received_fraction": 0, "used_fraction": 1}

Late = Sequence[NDArray[np.uint16]] | NDArray[np.uint16]


class WatchedSlots(NamedTuple):
    """A quantity to keep, and its slots from first to before end."""

    what: str
    """A figure, or `in_step`."""
    first: int
    end: int


def watch_of(scenario: Scenario, expect: ExpectTable) -> tuple[str, WatchedSlots] | None:
    """Receiver and the quantity an expectation needs; None where the summary's figures or theory are enough."""
    if expect.in_step is not None:
        return expect.in_step, WatchedSlots(IN_STEP, _since(scenario, expect), scenario.slots)
    if expect.figure is None or (expect.slots is None and expect.quantile is None):
        return None
    receiver, _, figure = expect.figure.partition(".")
    first, end = expect.slots or (0, scenario.slots)
    return None if figure == "expected_trace_covariance" else (receiver, WatchedSlots(figure, first, end))


def _since(scenario: Scenario, expect: ExpectTable) -> int:
    """The slot from which a receiver must come into step: as given, or that of the last event on it up to slot `by`."""
    if expect.since is not None:
        return expect.since
    by = scenario.slots if expect.by is None else expect.by
    over = [act.at for act in scenario.timeline.acts if expect.in_step in act.names and act.at <= by]
    return max(over, default=0)


def watches_of(scenario: Scenario) -> dict[str, tuple[WatchedSlots, ...]]:
    """Receiver → everything that the scenario's expectations need of it."""
    wanted = [watch for expect in scenario.expect if (watch := watch_of(scenario, expect)) is not None]
    return {name: tuple(dict.fromkeys(watch for one, watch in wanted if one == name)) for name in scenario.receivers}


@final
class Watched:
    """The sums kept of R trials."""

    def __init__(self, watches: Iterable[WatchedSlots], trials: int) -> None:
        self._trials = trials
        # A live run does not know the believed trace of each trial: its entry is the sum over all trials.
        self._kept = {
            watch: np.zeros(1) if watch.what == _TRACE else np.full(trials, _NEVER if watch.what == IN_STEP else 0.0)
            for watch in watches
        }

    def add(self, first: int, error: Floats, action: Codes, traces: Floats, late: Late | None = None) -> None:
        """Add c slots from `first` on: error and action (c, R), and the sum over trials of tr P, (c,).

        late: packets of earlier slots that arrived, and that were used, (c, R) each, for receivers that accept them.
        """
        for watch, kept in self._kept.items():
            rows = slice(max(watch.first - first, 0), min(watch.end - first, len(error)))
            if rows.start >= rows.stop:
                continue
            if watch.what == IN_STEP:
                states = action[rows] == Action.STATE
                new = states.any(axis=0) & (kept == _NEVER)
                kept[new] = first + rows.start + states.argmax(axis=0)[new]
            else:
                _add(kept, watch.what, error[rows], action[rows], traces[rows])
                if late is not None and watch.what in _LATE:
                    np.add(kept, late[_LATE[watch.what]][rows].sum(axis=0), out=kept)

    def means(self, watch: WatchedSlots) -> Floats:
        """The mean of a figure over the slots, for each trial, (R,)."""
        return self._kept[watch] / (watch.end - watch.first)

    def mean(self, watch: WatchedSlots) -> float:
        """The mean of a figure over the slots and trials."""
        return float(self.means(watch).sum()) / self._trials

    def quantile(self, watch: WatchedSlots, level: float) -> float:
        """A quantile over trials of a trial's mean over the slots."""
        return float(np.quantile(self.means(watch), level))

    def in_step(self, watch: WatchedSlots) -> int | None:
        """The largest over trials of the first slot in which a packet was used as the state; None if a trial has no such slot."""
        kept = self._kept[watch]
        return None if (kept == _NEVER).any() else int(kept.max())

    @classmethod
    def of(cls, parts: Sequence[Watched]) -> Watched:
        """The sums of disjoint sets of trials, in their order."""
        total = cls((), sum(part._trials for part in parts))
        for watch in parts[0]._kept:
            kept = [part._kept[watch] for part in parts]
            total._kept[watch] = np.sum(kept, axis=0) if watch.what == _TRACE else np.concatenate(kept)
        return total


def _add(kept: Floats, figure: str, error: Floats, action: Codes, traces: Floats) -> None:
    """Add some slots of a figure to its sums."""
    match figure:
        case "mean_squared_error":
            for row in error:
                kept += row
        case "mean_trace_covariance":
            for trace in traces:
                kept += trace
        case "received_fraction":
            kept += np.count_nonzero(action != Action.LOST, axis=0)
        case "used_fraction":
            kept += np.count_nonzero((action != Action.LOST) & (action != Action.DISCARDED), axis=0)
