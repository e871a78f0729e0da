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
from evedrop.live.protocol.codec import progress
from evedrop.live.protocol.telemetry import Decisions, Report, Truth
from evedrop.model.digest import BlockDigests, Blocks, BlockSums, Digests, InputLog
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Beliefs, Flags
from evedrop.model.slot.cores import Sent


def is_due(brief: AnyBrief, k: int) -> bool:
    """Whether slot k ends a report."""
    return (k + 1) % brief.flow.batch == 0 or k + 1 == brief.slots


@final
class TruthReporter:
    """The sensor's reports: states and schedule; sent flags, alarms and inputs, if the scenario has them.

    inputs: how many a controller decides; measures: whether the sensor filters its measurements; monitors: whether it has a
    detector for its filter.
    """

    def __init__(
        self,
        brief: AnyBrief,
        put: Callable[[int, bytes], None],
        may_be_silent: bool = False,
        watches: bool = False,
        inputs: int = 0,
        measures: bool = False,
        monitors: bool = False,
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
        self._statistic = np.empty(self._nu.shape) if monitors else None
        self._watermark = np.empty((brief.flow.batch, inputs, brief.trials)) if monitors else None
        self._first = 0

    def add_slots(
        self,
        slots: range,
        made: Sent,
        alarms: Flags | None = None,
        steered: tuple[Floats, Flags] | None = None,
    ) -> None:
        """Add consecutive slots, which do not cross the end of a report; report if one is due with the last of them.

        alarms (c, R); steered: the inputs (c, m, R), and the trials in which the decision failed, (c, R).
        """
        row = slots.start % self._brief.flow.batch
        rows = slice(row, row + len(slots))
        self._x[rows] = made.x
        self._nu[rows] = made.packets.nu
        for column, values in ((self._sent, made.packets.sent), (self._alarms, alarms)):
            if column is not None:
                column[rows] = values
        if steered is not None and self._u is not None and self._failed is not None:
            self._u[rows], self._failed[rows] = steered
        if self._true is not None:
            self._true[rows] = made.true
        if made.monitored is not None and self._statistic is not None and self._watermark is not None:
            self._statistic[rows], self._watermark[rows] = made.monitored.statistic, made.monitored.watermark
        if is_due(self._brief, slots[-1]):
            self.flush(slots.stop)

    def flush(self, end: int) -> None:
        """Report all slots below `end` that are not reported yet."""
        if end > self._first:
            row = self._first % self._brief.flow.batch
            rows = slice(row, row + end - self._first)
            sent, alarms, failed = (
                None if column is None else column[rows] for column in (self._sent, self._alarms, self._failed)
            )
            u, *others = (
                None if column is None else column[rows]
                for column in (self._u, self._true, self._statistic, self._watermark)
            )
            truth = Truth(self._first, self._x[rows], self._nu[rows], sent, alarms, u, failed, *others)
            self._put(end - 1, truth.pack())
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

    def add_decision(self, k: int, u: Floats, failed: Flags, seconds: float) -> None:
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
        self._blocks = Blocks(brief.slots, cuts)
        self._log = BlockDigests(brief.trials, brief.slots, cuts)
        self._digests: dict[int, Digests] = {}
        self._sums = BlockSums(brief.trials, brief.slots, cuts) if brief.recorded < brief.trials else None
        self._trace_sums: dict[int, Floats] = {}
        n, batch = len(brief.model.A), brief.flow.batch
        self._beliefs = Beliefs(
            np.empty((batch, n, brief.trials)),
            np.empty((batch, n, n, brief.recorded)),
            np.empty((batch, brief.trials), np.uint8),
        )
        self._trace = np.empty((batch, 2))
        self._late = np.empty((2, batch, brief.trials), np.uint16) if counts_late else None
        self._first = first

    def add_slots(self, slots: range, beliefs: Beliefs, late: NDArray[np.uint16] | None = None) -> None:
        """Add consecutive slots, and report where a report is due.

        late: how many late packets arrived and how many were used, (2, c, R), if the receiver can use them.
        """
        k, batch = slots.start, self._brief.flow.batch
        while k < slots.stop:
            end = min(slots.stop, self._blocks.end(k), k - k % batch + batch)
            rows = slice(k - slots.start, end - slots.start)
            self._keep(range(k, end), beliefs.rows(rows), None if late is None else late[:, rows])
            if is_due(self._brief, end - 1):
                self.flush(end)
            k = end

    def _keep(self, slots: range, beliefs: Beliefs, late: NDArray[np.uint16] | None) -> None:
        """Keep slots that are all in one report and one block of the digest."""
        row = slots.start % self._brief.flow.batch
        rows = slice(row, row + len(slots))
        self._beliefs.x_hat[rows], self._beliefs.action[rows] = beliefs.x_hat, beliefs.action
        self._beliefs.P[rows] = beliefs.P[..., : self._brief.recorded]
        trace = kernels.traces(beliefs.P)
        self._trace[rows, 0], self._trace[rows, 1] = trace.sum(axis=1), (trace * trace).sum(axis=1)
        if self._late is not None and late is not None:
            self._late[:, rows] = late
        self._digests.update(self._log.add(slots, beliefs))
        if self._sums is not None:
            self._trace_sums.update(self._sums.add(slots, trace))

    def flush(self, end: int) -> None:
        """Report all slots below `end`, and the progress to there."""
        self._report(end)
        self._put_progress(end - 1, progress(end))

    def skip(self, end: int) -> None:
        """Go on from slot `end`: the recorder reports the slots before it, in which this receiver was absent."""
        self._first = end

    def _report(self, end: int) -> None:
        if end == self._first:
            return
        row = self._first % self._brief.flow.batch
        rows = slice(row, row + end - self._first)
        late = None if self._late is None else self._late[:, rows]
        report = Report(
            self._first,
            self._beliefs.x_hat[rows],
            self._beliefs.action[rows],
            self._beliefs.P[rows],
            self._trace[rows],
            None if late is None else late[0],
            self._digests,
            None if late is None else late[1],
            self._trace_sums,
        )
        self._put(end - 1, report.pack())
        self._first, self._digests, self._trace_sums = end, {}, {}
