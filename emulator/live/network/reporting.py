"""The reports of each process, and when it sends them: columns of many slots, never a message per number.

Reports end at the same slots in every process: at the end of every `flow.batch` slots, at the last slot, and at every
barrier. So a full window always holds a reported slot, and no process waits for a report that itself waits for a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.closed_loop import Decisions
from evedrop.live.protocol.codec import progress
from evedrop.live.protocol.telemetry import Report, Truth
from evedrop.model.digest import BeliefLog, Digests, InputLog
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Flags, trace_of


def is_due(brief: AnyBrief, k: int) -> bool:
    """Whether slot k ends a report."""
    return (k + 1) % brief.flow.batch == 0 or k + 1 == brief.slots


@final
class TruthReporter:
    """The sensor's reports: states and schedule; sent flags, alarms and inputs, if the scenario has them.

    inputs: how many a controller decides; measures: whether the sensor filters its measurements.
    """

    def __init__(
        self,
        brief: AnyBrief,
        put: Callable[[int, bytes], None],
        may_be_silent: bool = False,
        watches: bool = False,
        inputs: int = 0,
        measures: bool = False,
    ) -> None:
        self._brief = brief
        self._put = put
        self._x = np.empty((brief.flow.batch, len(brief.model.A), brief.trials))
        self._nu = np.empty((brief.flow.batch, brief.trials), np.bool_)
        self._sent = np.ones_like(self._nu) if may_be_silent else None
        self._alarms = np.zeros_like(self._nu) if watches else None
        self._u = np.empty((brief.flow.batch, inputs, brief.trials)) if inputs else None
        self._failed = np.zeros_like(self._nu) if inputs else None
        self._true = np.empty_like(self._x) if measures else None
        self._first = 0

    def add(
        self,
        k: int,
        x: Floats,
        nu: Flags,
        sent: Flags | None = None,
        alarms: Flags | None = None,
        steered: tuple[Floats, Flags] | None = None,
        true: Floats | None = None,
    ) -> None:
        """Add slot k, and report if a report is due.

        steered: its inputs (m, R), and the trials in which the decision failed, (R,); true: its true state, (n, R), if x
        is a filter's.
        """
        row = k % self._brief.flow.batch
        self._x[row] = x
        self._nu[row] = nu
        for column, values in ((self._sent, sent), (self._alarms, alarms)):
            if column is not None:
                column[row] = values
        if steered is not None and self._u is not None and self._failed is not None:
            self._u[row], self._failed[row] = steered
        if true is not None and self._true is not None:
            self._true[row] = true
        if is_due(self._brief, k):
            self.flush(k + 1)

    def flush(self, end: int) -> None:
        """Report all slots below `end` that are not reported yet."""
        if end > self._first:
            row = self._first % self._brief.flow.batch
            rows = slice(row, row + end - self._first)
            sent, alarms, failed = (
                None if column is None else column[rows] for column in (self._sent, self._alarms, self._failed)
            )
            u, true = (None if column is None else column[rows] for column in (self._u, self._true))
            self._put(end - 1, Truth(self._first, self._x[rows], self._nu[rows], sent, alarms, u, failed, true).pack())
        self._first = end


@final
class DecisionReporter:
    """The controller's reports: decision times, and digests of the decisions."""

    def __init__(self, brief: AnyBrief, put: Callable[[int, bytes], None], inputs: int, period: int) -> None:
        self._brief, self._put, self._period = brief, put, period
        self._log = InputLog(inputs, brief.trials, brief.slots)
        self._digests: dict[int, Digests] = {}
        self._seconds: list[float] = []
        self._first = 0

    def add(self, k: int, u: Floats, failed: Flags, seconds: float) -> None:
        """Add the decision of slot k, which holds until the next decision; report if a report is due."""
        end, batch = min(k + self._period, self._brief.slots), self._brief.flow.batch
        for slot in range(k, end):
            self._digests.update(filter(None, [self._log.add(slot, u, failed)]))
        self._seconds.append(seconds)
        if end // batch > self._first // batch or end == self._brief.slots:
            seconds_taken = np.array(self._seconds)
            self._put(end - 1, Decisions(self._first, end - self._first, seconds_taken, self._digests).pack())
            self._first, self._seconds, self._digests = end, [], {}


@final
class BeliefReporter:
    """A receiver's reports: estimates, actions, recorded covariances, digests, and its progress.

    put, put_progress: called with the last slot that a message covers, and the message. cuts: slots in which the receiver
    goes away or returns. first: its first slot. counts_late: whether it can use late packets.
    """

    def __init__(
        self,
        brief: AnyBrief,
        put: Callable[[int, bytes], None],
        put_progress: Callable[[int, bytes], None],
        cuts: Iterable[int] = (),
        first: int = 0,
        counts_late: bool = False,
    ) -> None:
        self._brief = brief
        self._put = put
        self._put_progress = put_progress
        self._log = BeliefLog(len(brief.model.A), brief.trials, brief.slots, cuts, first)
        self._late = np.zeros((2, brief.flow.batch, brief.trials), np.uint16) if counts_late else None
        self._first = first

    def add(self, k: int, belief: Belief, late: tuple[NDArray[np.uint16], NDArray[np.uint16]] | None = None) -> None:
        """Add slot k, and report if a report is due: also at the end of a digest's block, where the log starts over.

        late: how many late packets arrived and how many were used in each trial, (R,) each.
        """
        if self._late is not None:
            self._late[:, k % self._brief.flow.batch] = 0 if late is None else late
        digests = self._log.add(k, belief)
        if digests is not None or is_due(self._brief, k):
            self._report(k + 1, {} if digests is None else dict([digests]))
        if is_due(self._brief, k):
            self._put_progress(k, progress(k + 1))

    def flush(self, end: int) -> None:
        """Report all slots below `end`, and the progress to there."""
        self._report(end, {})
        self._put_progress(end - 1, progress(end))

    def skip(self, end: int) -> None:
        """Go on from slot `end`: the observer reports the slots before it, in which this receiver was absent."""
        self._first = end

    def _report(self, end: int, digests: dict[int, Digests]) -> None:
        if end == self._first:
            return
        log = self._log.rows(self._first, end)
        trace = trace_of(log.P.transpose(1, 2, 0, 3))
        row = self._first % self._brief.flow.batch
        report = Report(
            self._first,
            log.x_hat,
            log.action,
            np.ascontiguousarray(log.P[..., : self._brief.recorded]),
            np.stack([trace.sum(axis=1), (trace * trace).sum(axis=1)], axis=1),
            None if self._late is None else self._late[0, row : row + end - self._first],
            digests,
            None if self._late is None else self._late[1, row : row + end - self._first],
        )
        self._put(end - 1, report.pack())
        self._first = end
