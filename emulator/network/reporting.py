"""What a process reports, and when: columns of many slots, never a message per number.

Reports end at the same slots everywhere: at the end of every `flow.batch` slots, and at the last. So a window that is
full always holds a reported slot, and nobody can wait for a report that itself waits for a packet.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from emulator.brief import Brief
from emulator.model.digest import BLOCK_SLOTS, BeliefLog
from emulator.model.process import Floats
from emulator.model.receiver import Belief, Flags, trace_of
from emulator.network.wire import Report, Truth, progress


def is_due(brief: Brief, k: int) -> bool:
    """Whether slot k ends a report."""
    return (k + 1) % brief.flow.batch == 0 or k + 1 == brief.slots


class TruthReporter:
    """The sensor's reports: states and schedule. Final."""

    def __init__(self, brief: Brief, put: Callable[[bytes], None]) -> None:
        self._brief = brief
        self._put = put
        self._x = np.empty((brief.flow.batch, len(brief.model.A), brief.trials))
        self._nu = np.empty((brief.flow.batch, brief.trials), np.bool_)

    def add(self, k: int, x: Floats, nu: Flags) -> None:
        """Take slot k, and report if it is time."""
        row = k % self._brief.flow.batch
        self._x[row] = x
        self._nu[row] = nu
        if is_due(self._brief, k):
            self._put(Truth(k - row, self._x[: row + 1], self._nu[: row + 1]).pack())


class BeliefReporter:
    """A receiver's reports: estimates, actions, recorded covariances, digests, and its progress. Final."""

    def __init__(self, brief: Brief, put: Callable[[bytes], None], put_progress: Callable[[bytes], None]) -> None:
        self._brief = brief
        self._put = put
        self._put_progress = put_progress
        self._log = BeliefLog(len(brief.model.A), brief.trials, brief.slots)
        self._first = 0

    def add(self, k: int, belief: Belief) -> None:
        """Take slot k, and report if it is time: also at the end of a digest's block, where the log starts anew."""
        digests = self._log.add(k, belief)
        if digests is None and not is_due(self._brief, k):
            return
        log = self._log.rows(self._first, k + 1)
        trace = trace_of(log.P.transpose(1, 2, 0, 3))
        report = Report(
            self._first,
            log.x_hat,
            log.action,
            np.ascontiguousarray(log.P[..., : self._brief.recorded]),
            np.stack([trace.sum(axis=1), (trace * trace).sum(axis=1)], axis=1),
            {} if digests is None else {k // BLOCK_SLOTS: digests},
        )
        self._put(report.pack())
        self._first = k + 1
        if is_due(self._brief, k):
            self._put_progress(progress(k + 1))
