"""Joins the reports of all processes into slots: a slot is complete when every process has reported it.

On behalf of an absent receiver the recorder reports by itself, so that every slot of every receiver is accounted for.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Generic, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from evedrop.live.network.reporting import BeliefReporter
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import (
    Extent,
    Journal,
    Report,
    Truth,
    read_decisions,
    read_journal,
    read_report,
    read_truth,
)
from evedrop.model.digest import Blocks, DigestLog
from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.model.links.loss_model import REASONS
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, prior
from evedrop.model.slot.cores import Absence
from evedrop.model.slot.link import Account, ReceiverOutage
from evedrop.names import CONTROLLER, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.score.slots import InputSlots, ReceiverSlots, Slots, all_set

Message = TypeVar("Message")


@final
class Joiner:
    """Takes the messages of all processes as they come, and returns slots as soon as all have reported them."""

    def __init__(
        self,
        extent: Extent,
        windows: Mapping[str, int],
        blocks: Mapping[str, Blocks],
        period: int | None = None,
        check: Callable[[str, Report], None] = lambda _name, _report: None,
    ) -> None:
        """windows: receiver → slots by which a packet may be late for it; blocks: receiver or controller → its digests' blocks.

        period: the controller's period; None without a controller. check: called with every receiver's report before use.
        """
        self._check = check
        self._extent, self._windows, self._blocks, self._period = extent, windows, blocks, period
        self._decided = 0
        self._truth = _Column[Truth]()
        self._journal = _Column[Journal]()
        self._reports = {name: _Column[Report]() for name in windows}
        self._done = 0
        self.digests = {name: DigestLog() for name in windows}
        """Receiver or controller → first slot of a block → its digests, (R, 16)."""
        if period is not None:
            self.digests[CONTROLLER] = DigestLog()
        self.trace_sums: dict[str, Floats] = {}
        """Receiver → sum of tr P of each trial over all finished blocks, (R,); only if not all trials are recorded."""

    @property
    def done(self) -> int:
        """The first slot that has not been returned."""
        return self._done

    @property
    def sent(self) -> int:
        """The first slot that the sensor has not reported."""
        return self._truth.end

    @property
    def journaled(self) -> int:
        """The first slot that the router has not journaled."""
        return self._journal.end

    def reported(self, name: str) -> int:
        """The first slot that a receiver, or the controller, has not reported."""
        return self._decided if name == CONTROLLER else self._reports[name].end

    def places(self, reporters: Iterable[str]) -> dict[str, int]:
        """Process → the first slot that it has not reported, for sensor, router, and these reporters."""
        return {SENSOR: self.sent, ROUTER: self.journaled, **{name: self.reported(name) for name in reporters}}

    def complete(self, slots: int) -> bool:
        """Whether this many slots have been returned and, if there is a controller, it has reported them, too."""
        return self._done == slots and (self._period is None or self._decided == slots)

    def add_decisions(self, telemetry: Reader) -> Floats:
        """Take the controller's telemetry; returns the seconds that each decision took."""
        message = read_decisions(telemetry, self._decided, self._extent, self._blocks[CONTROLLER], self._period or 1)
        self._decided += message.count
        self.digests[CONTROLLER].add(message.digests)
        return message.seconds

    def add_truth(self, telemetry: Reader) -> None:
        """Take the sensor's telemetry."""
        message = read_truth(telemetry, self._truth.end, self._extent)
        self._truth.add(message, message.count)

    def add_report(self, name: str, telemetry: Reader) -> None:
        """Take a receiver's telemetry."""
        column = self._reports[name]
        message = read_report(telemetry, column.end, self._extent, self._blocks[name], self._windows[name])
        self._check(name, message)
        column.add(message, message.count)
        self.digests[name].add(message.digests)
        for block in sorted(message.trace_sums):
            self.trace_sums[name] = self.trace_sums.get(name, 0.0) + message.trace_sums[block]

    def add_journal(self, journal: Reader) -> Mapping[str, Account]:
        """Take the router's journal; returns the accounts in it."""
        message = read_journal(journal, self._journal.end, self._windows, self._extent)
        self._journal.add(message, message.count)
        return message.links

    def take_slots(self) -> Slots | None:
        """The next slots that all processes have reported, or None."""
        count = min(self._truth.available, self._journal.available, *(c.available for c in self._reports.values()))
        if count == 0:
            return None
        first, self._done = self._done, self._done + count
        truth = self._truth.take(count)
        journal = self._journal.take(count)
        receivers = {}
        for name, window in self._windows.items():
            parts = self._reports[name].take(count)
            receivers[name] = ReceiverSlots(
                x_hat=_rows(parts, [part.x_hat for part, _ in parts]),
                action=_rows(parts, [part.action for part, _ in parts]),
                P=_rows(parts, [part.P for part, _ in parts]),
                trace=_rows(parts, [part.trace for part, _ in parts]),
                delivered=_rows(journal, [part.links[name].delivered for part, _ in journal]),
                lost={
                    reason: _rows(journal, [part.links[name].lost[reason] for part, _ in journal]) for reason in REASONS
                },
                late=_rows(parts, [_known(part.late, part.action) for part, _ in parts]) if window else None,
                late_used=_rows(parts, [_known(part.late_used, part.action) for part, _ in parts]) if window else None,
                late_delivered=_rows(
                    journal, [_known(link.late, link.delivered) for link in (part.links[name] for part, _ in journal)]
                )
                if window
                else None,
                unsent=_counted([(part.links[name].unsent, part.count, rows) for part, rows in journal]),
            )
        x = _rows(truth, [part.x for part, _ in truth])
        nu = _rows(truth, [part.nu for part, _ in truth])
        sent, alarms = (
            None
            if getattr(truth[0][0], name) is None
            else _rows(truth, [all_set(getattr(part, name), part.nu) for part, _ in truth])
            for name in ("sent", "alarms")
        )
        inputs = None
        if self._extent.inputs:
            u, failed = (_rows(truth, [getattr(part, name) for part, _ in truth]) for name in ("u", "failed"))
            inputs = InputSlots(u, failed)
        if inputs is not None and self._extent.monitored:
            statistic, watermark = (
                _rows(truth, [getattr(part, name) for part, _ in truth]) for name in ("statistic", "watermark")
            )
            inputs = replace(inputs, monitored=MonitoredSlots(statistic, watermark))
        true = (
            _rows(truth, [part.true for part, _ in truth if part.true is not None]) if self._extent.measures else None
        )
        return Slots(first, x, nu, receivers, sent, alarms, inputs, true)


def _counted(parts: list[tuple[NDArray[np.uint32] | None, int, slice]]) -> NDArray[np.uint32] | None:
    """Counts for some slots, from parts with their lengths and rows; 0 for parts without counts; None if no part has any."""
    if all(counts is None for counts, _, _ in parts):
        return None
    return np.concatenate(
        [(np.zeros(count, np.uint32) if counts is None else counts)[rows] for counts, count, rows in parts]
    )


class _Column(Generic[Message]):
    """Messages of one sender, and how many of their slots have been taken."""

    def __init__(self) -> None:
        self._messages: deque[tuple[Message, int]] = deque()
        self._taken = 0  # slots taken from the first message
        self.end = 0
        self.available = 0

    def add(self, message: Message, count: int) -> None:
        self._messages.append((message, count))
        self.end += count
        self.available += count

    def take(self, count: int) -> list[tuple[Message, slice]]:
        """The next slots, as messages with the slices of their rows."""
        self.available -= count
        parts = []
        while count:
            message, length = self._messages[0]
            rows = slice(self._taken, min(length, self._taken + count))
            parts.append((message, rows))
            count -= rows.stop - rows.start
            self._taken = rows.stop
            if self._taken == length:
                self._messages.popleft()
                self._taken = 0
        return parts


def _known(late: NDArray[np.uint16] | None, like: NDArray[Any]) -> NDArray[np.uint16]:
    """Counts of late packets, 0 where none are given."""
    return np.zeros(like.shape, np.uint16) if late is None else late


def _rows(parts: list[tuple[Message, slice]], arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """The rows of the parts' arrays, one after the other."""
    chosen = [array[rows] for array, (_, rows) in zip(arrays, parts, strict=True)]
    return chosen[0] if len(chosen) == 1 else np.concatenate(chosen)


@final
class AbsenceReporter:
    """Reports the beliefs of a receiver that is away, computed from its belief when it left.

    brief: of the recorder; put: takes the reports as if they were the receiver's own.
    """

    def __init__(
        self,
        brief: AnyBrief,
        scenario: Scenario,
        receiver: str,
        away: ReceiverOutage,
        left: Belief,
        put: Callable[[bytes], None],
    ) -> None:
        process = scenario.process.process
        fresh = prior(process, scenario.trials, away.start)
        self._absence = Absence(process, left if away.keeps_state else fresh)
        cuts, late = scenario.outage_bounds(receiver), scenario.window(receiver) > 0
        self._reporter = BeliefReporter(brief, lambda _, payload: put(payload), lambda *_: None, cuts, away.start, late)
        self.next = away.start
        """The first slot that has not been reported."""
        self._stop = min(away.stop, scenario.slots)

    @property
    def over(self) -> bool:
        """Whether all slots of the outage are reported."""
        return self.next == self._stop

    def follow(self, end: int) -> None:
        """Report the slots of the outage below `end`."""
        slots = range(self.next, min(end, self._stop))
        if slots:
            self._reporter.add_slots(slots, self._absence.take_slots(slots))
            self.next = slots.stop
        self._reporter.flush(self.next)
