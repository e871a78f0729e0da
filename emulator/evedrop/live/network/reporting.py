"""The reports of each process, and when it sends them: columns of many slots, never a message per number.

Reports end at the same slots in every process: at the end of every `flow.batch` slots, at the last slot, and at every
barrier. So a full window always holds a reported slot, and no process waits for a report that itself waits for a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import final

import numpy as np

from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.notices import Progress
from evedrop.live.protocol.telemetry import Decisions, Report, truth
from evedrop.model.digest import BlockDigests, Blocks, BlockSums, Digests, InputLog
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.slot.records import ReceiverSlots, SensorSlots

_PART_BYTES = 1 << 16  # of covariances that wait: single slots are joined before their digests are computed


def is_due(brief: AnyBrief, k: int) -> bool:
    """Whether slot k ends a report."""
    return (k + 1) % brief.flow.batch == 0 or k + 1 == brief.slots


@final
class TruthReporter:
    """The sensor's reports."""

    def __init__(self, brief: AnyBrief, put: Callable[[int, bytes], None]) -> None:
        self._brief, self._put = brief, put
        self._held: list[SensorSlots] = []

    def add_slots(self, slots: SensorSlots) -> None:
        """Add consecutive slots, which do not cross the end of a report; report if one is due with the last of them."""
        self._held.append(slots)
        if is_due(self._brief, slots.first + slots.count - 1):
            self.flush()

    def flush(self) -> None:
        """Report all slots that are not reported yet."""
        if self._held:
            slots = SensorSlots.joined(self._held)
            self._put(slots.slots[-1], truth(slots))
            self._held = []


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
    goes away or returns.
    """

    def __init__(
        self,
        brief: AnyBrief,
        put: Callable[[int, bytes], None],
        put_progress: Callable[[int, bytes], None],
        cuts: Iterable[int] = (),
    ) -> None:
        self._brief = brief
        self._put = put
        self._put_progress = put_progress
        self._blocks = Blocks(brief.slots, cuts)
        self._log = BlockDigests(brief.trials, brief.slots, cuts)
        self._digests: dict[int, Digests] = {}
        self._sums = BlockSums(brief.trials, brief.slots, cuts) if brief.recorded < brief.trials else None
        self._trace_sums: dict[int, Floats] = {}
        self._parts: list[ReceiverSlots] = []
        self._part_bytes = 0
        self._held: list[ReceiverSlots] = []

    def add_slots(self, slots: ReceiverSlots) -> None:
        """Add consecutive slots, with the covariances of all trials, and report where a report is due."""
        first, k, batch = slots.first, slots.first, self._brief.flow.batch
        stop = first + slots.count
        while k < stop:
            end = min(stop, self._blocks.end(k), k - k % batch + batch)
            part = slots if end - k == slots.count else slots.rows(slice(k - first, end - first))
            self._parts.append(part)
            self._part_bytes += part.P.nbytes
            due = is_due(self._brief, end - 1)
            if due or end == self._blocks.end(k) or self._part_bytes >= _PART_BYTES:
                self._take_parts()
            if due:
                self.flush(end)
            k = end

    def _take_parts(self) -> None:
        """Compute digests and sums of the parts that wait; all are in one report and one block of the digest."""
        if not self._parts:
            return
        slots = ReceiverSlots.joined(self._parts)
        self._parts, self._part_bytes = [], 0
        trace = kernels.traces(slots.P)
        self._digests.update(self._log.add(slots.slots, slots.beliefs))
        if self._sums is not None:
            self._trace_sums.update(self._sums.add(slots.slots, trace))
        sums = kernels.sums(trace)
        P, recorded = slots.P, self._brief.recorded
        if recorded < self._brief.trials:
            P = P[..., :recorded].copy()  # a view would keep the covariances of all trials until the report
        self._held.append(slots.changed(P=P, trace=sums))

    def flush(self, end: int) -> None:
        """Report all slots that are not reported yet, and the progress to slot `end`."""
        self._take_parts()
        if self._held:
            report = Report(ReceiverSlots.joined(self._held), self._digests, self._trace_sums)
            self._put(end - 1, report.pack())
            self._held, self._digests, self._trace_sums = [], {}, {}
        self._put_progress(end - 1, Progress(end).pack())
