"""Joins the reports of all processes into slots: a slot is complete when every process has reported it.

On behalf of an absent receiver the recorder reports by itself, so that every slot of every receiver is accounted for.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Generic, TypeVar, final

from evedrop.live.network.reporting import BeliefReporter
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import (
    Extent,
    Report,
    read_decisions,
    read_journal,
    read_report,
    read_truth,
)
from evedrop.model.digest import Blocks, DigestLog
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, prior
from evedrop.model.record import Record, columns
from evedrop.model.slot.cores import Absence
from evedrop.model.slot.link import Account, ReceiverOutage
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots
from evedrop.names import CONTROLLER, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.score.slots import Slots

Kind = TypeVar("Kind", bound=Record)
Count = TypeVar("Count")


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
        self._truth = _Queue(SensorSlots)
        self._links = {name: _Queue(LinkSlots) for name in windows}
        self._reports = {name: _Queue(ReceiverSlots) for name in windows}
        self._accounts, self._seconds = _Counts[Mapping[str, Account]](), _Counts[float]()
        self.done = 0
        """The first slot that has not been returned."""
        self.digests = {name: DigestLog() for name in windows}
        """Receiver or controller → first slot of a block → its digests, (R, 16)."""
        if period is not None:
            self.digests[CONTROLLER] = DigestLog()
        self.trace_sums: dict[str, Floats] = {}
        """Receiver → sum of tr P of each trial over all finished blocks, (R,); only if not all trials are recorded."""

    @property
    def settled(self) -> int:
        """The first slot that has not been returned, or that a controller has not reported: all earlier reports are here."""
        return self.done if self._period is None else min(self.done, self._decided)

    @property
    def sent(self) -> int:
        """The first slot that the sensor has not reported."""
        return self._truth.end

    @property
    def journaled(self) -> int:
        """The first slot that the router has not journaled."""
        return min(links.end for links in self._links.values())

    def reported(self, process: str) -> int:
        """The first slot that a process has not reported."""
        if process in self._reports:
            return self._reports[process].end
        return {SENSOR: self.sent, ROUTER: self.journaled, CONTROLLER: self._decided}[process]

    def places(self, reporters: Iterable[str]) -> dict[str, int]:
        """Process → the first slot that it has not reported, for sensor, router, and these reporters."""
        return {name: self.reported(name) for name in (SENSOR, ROUTER, *reporters)}

    def complete(self, slots: int) -> bool:
        """Whether this many slots have been returned and, if there is a controller, it has reported them, too."""
        return self.done == slots and (self._period is None or self._decided == slots)

    def add_decisions(self, telemetry: Reader) -> None:
        """Take the controller's telemetry."""
        period = self._period or 1
        message = read_decisions(telemetry, self._decided, self._extent, self._blocks[CONTROLLER], period)
        first = -(-self._decided // period) * period
        for number, seconds in enumerate(message.seconds.tolist()):
            self._seconds.add(first + number * period + 1, seconds)
        self._decided += message.count
        self.digests[CONTROLLER].add(message.digests)

    def add_truth(self, telemetry: Reader) -> None:
        """Take the sensor's telemetry."""
        slots = read_truth(telemetry, self._truth.end, self._extent)
        if (changed := self._truth.changed(slots)) is not None:
            raise telemetry.malformed(f"{changed} in only some of the slots", "the same columns in every message")
        self._truth.add(slots)

    def add_report(self, name: str, telemetry: Reader) -> None:
        """Take a receiver's telemetry."""
        reports = self._reports[name]
        message = read_report(telemetry, reports.end, self._extent, self._blocks[name], self._windows[name])
        self._check(name, message)
        reports.add(message.slots)
        self.digests[name].add(message.digests)
        for block in sorted(message.trace_sums):
            self.trace_sums[name] = self.trace_sums.get(name, 0.0) + message.trace_sums[block]

    def add_journal(self, journal: Reader) -> None:
        """Take the router's journal."""
        message = read_journal(journal, self.journaled, self._windows, self._extent)
        for name, account in message.links.items():
            self._links[name].add(account.slots)
        self._accounts.add(self.journaled, message.links)

    def take_accounts(self) -> list[Mapping[str, Account]]:
        """The next accounts of the links all of whose slots have been returned."""
        return self._accounts.take(self.done)

    def take_seconds(self) -> list[float]:
        """The seconds of the next decisions whose first slot has been returned."""
        return self._seconds.take(self.done)

    def take_slots(self) -> Slots | None:
        """The next slots that all processes have reported, or None."""
        links, reports = self._links.values(), self._reports.values()
        count = min(self._truth.end, *(queue.end for queue in links), *(queue.end for queue in reports)) - self.done
        if count == 0:
            return None
        self.done += count
        return Slots(
            self._truth.take(count),
            {name: reports.take(count) for name, reports in self._reports.items()},
            {name: links.take(count) for name, links in self._links.items()},
        )


class _Queue(Generic[Kind]):
    """Records of consecutive slots of one sender."""

    def __init__(self, kind: type[Kind]) -> None:
        self._kind = kind
        self._records: deque[Kind] = deque()
        self._columns: list[str] | None = None
        self.end = 0
        """The first slot that is not here yet."""

    def changed(self, record: Kind) -> str | None:
        """An optional column that is in this record and not in those before it, or the other way round; None if none is."""
        there = [entry.name for entry in columns(self._kind) if getattr(record, entry.name) is not None]
        self._columns = self._columns or there
        return next(iter(set(there) ^ set(self._columns)), None)

    def add(self, record: Kind) -> None:
        """Add the next slots."""
        self._records.append(record)
        self.end += record.count

    def take(self, count: int) -> Kind:
        """Remove the first slots, as one record; there must be as many."""
        parts: list[Kind] = []
        while count:
            record = self._records.popleft()
            if record.count > count:
                self._records.appendleft(record.rows(slice(count, None)))
                record = record.rows(slice(0, count))
            parts.append(record)
            count -= record.count
        return self._kind.joined(parts)


class _Counts(Generic[Count]):
    """What is counted once its slots have been returned."""

    def __init__(self) -> None:
        self._counts: deque[tuple[int, Count]] = deque()

    def add(self, end: int, count: Count) -> None:
        """Add the next count, of slots below `end`."""
        self._counts.append((end, count))

    def take(self, done: int) -> list[Count]:
        """Remove those whose slots are all below `done`."""
        taken = []
        while self._counts and self._counts[0][0] <= done:
            taken.append(self._counts.popleft()[1])
        return taken


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
        self._absence = Absence(process, left if away.keeps_state else fresh, scenario.window(receiver))
        cuts = scenario.outage_bounds(receiver)
        self._reporter = BeliefReporter(brief, lambda _, payload: put(payload), lambda *_: None, cuts)
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
            self._reporter.add_slots(self._absence.take_slots(slots))
            self.next = slots.stop
        self._reporter.flush(self.next)
