"""Says what must hold of a simulated wire: its journal is true to what its receivers got, and its fates are those of its models.

What a fault may take is left out: messages that were on their way when it struck, and records that the disk refused.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import signal
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Protocol, final

import zenoh

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.model.slot.link import NEVER, Fates, Link, LinkSchedule, streams_of
from evedrop.model.streams import Batch, root_of_seed
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE, WireSummary
from evedrop.scenario.receivers import wire_stream_key
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.faults import (
    CutPower,
    DiskDisturbance,
    FreezeConnection,
    InterruptProcess,
    KillProcess,
    SlowConnection,
    StopProcess,
)
from evedrop.virtual.processes import VirtualProcess
from evedrop.virtual.run import SimulatedRun
from evedrop.virtual.world import EPOCH
from evedrop.virtual.zenoh.access import intersects
from evedrop.wire.file import load_wire, resolved_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import summary_of_wire
from evedrop.wire.plan import WireLink, WirePlan, numbered_as
from evedrop.wire.records import REASONS, WireFate
from tests.faults.wires import wrong_numbers, wrong_summary
from tests.virtual.small_limits import FEW_KEYS, FULL, HUNG
from tests.virtual.wire_commands import JOINED, MOVED, OPENED, REPLAY, REPLAY_FILE, VIEW, VIEW_FILE, wrong_recording
from tests.virtual.wire_course import (
    wrong_arrivals,
    wrong_counts,
    wrong_csv,
    wrong_cuts,
    wrong_order,
    wrong_rates,
    wrong_reasons,
)
from tests.virtual.wire_programs import Course, Message, WireProgram, gid_of, ros_key, ros_token, service, stream_of
from tests.virtual.wire_tokens import wrong_tokens

Row = dict[str, Any]
DISK = "disk"
_LEASE = 10.0
_DOUBT = 7.0
"""For how long after a further start, or after a connection may be made again, a reader may still be away."""
_ARRIVING, _LEAVING = 1.0, 1.0
"""Seconds after a program has begun, and before its end, in which messages may miss it."""
_DROPPING = 0.5
"""Seconds from when the wire lets a message go, within which Zenoh may drop it."""
_ROUNDING = 1e-5
"""Seconds, more than a time of day is rounded by."""
_TIMEOUT_BYTES = 7
"""Of the answer with which Zenoh says that a time limit is over."""
_CUT = {"cut", "overflow", "too_large", "looped"}
"""Reasons that come before what the models of a link decide."""


class JudgedCase(Protocol):
    """The part of a case that is judged."""

    @property
    def seconds(self) -> float:
        """For which each start runs."""

    @property
    def operations(self) -> tuple[tuple[float, str], ...]:
        """What operators type."""

    @property
    def further(self) -> tuple[str, ...]:
        """What else is done."""


@final
class WireJudge:
    """Says what must hold and does not."""

    def __init__(
        self, case: JudgedCase, plan: WirePlan, course: Course, run: SimulatedRun, struck: Mapping[Disturbance, float]
    ) -> None:
        self._case, self._plan, self._course, self._run, self._struck = case, plan, course, run, struck
        self._disk = any(isinstance(fault, DiskDisturbance) for fault in struck)
        self._killed = any(isinstance(fault, KillProcess) for fault in struck) or self._disk
        self._hung = HUNG in case.further and "the wire no longer answers" in run.said
        self._killed |= self._hung
        self._targets = {link.name: link.target for link in plan.links}

    def misses(self) -> Iterator[str]:
        """The broken promises."""
        run, course = self._run, self._course
        if run.stuck is not None:
            yield f"stuck: {run.stuck}"
            return
        yield from (f"{thread}: {type(error).__name__}: {error}" for thread, error in run.errors)
        yield from (line for line in run.said.splitlines() if "Traceback" in line or "report this" in line)
        yield from course.damaged
        for process in course.processes:
            yield from self._of_status(process)
        if MOVED not in self._case.further:  # or else it is elsewhere
            yield from self._of_journal()

    def _of_journal(self) -> Iterator[str]:
        """What must hold of the journal, the summary, and those who read them."""
        run, course = self._run, self._course
        try:
            starts = range(1, len(course.begun) + 1)
            rows = {
                number: [row for table in journal_tables(run.folder, number) for row in table.to_pylist()]
                for number in starts
            }
        except UsageError as error:
            if not self._disk:
                yield f"the journal cannot be read: {error}"
            return
        yield from self._of_latest()
        if self._disk:  # which may not have the name of a key
            rows = {number: [row for row in some if not _has_no_name(row)] for number, some in rows.items()}
        flat = [row for some in rows.values() for row in some]
        yield from self._wrong_fates(flat)
        yield from self._too_early(flat)
        if not self._disk:
            yield from wrong_numbers(_numbered(rows))
        if JOINED not in self._case.further:
            yield from self._true_to_receivers(flat)
        yield from self._wrong_senders(flat)
        if run.status in {0, 1} and not self._disk and not self._hung:
            yield from self._of_summary(rows)
        if not (self._struck or self._hung):
            yield from self._of_course(rows, flat)
            yield from course.doubts
            yield from self._of_operators()
            if JOINED not in self._case.further:
                yield from wrong_tokens(self._plan, course, course.begun[0] + self._case.seconds)
        if not self._killed:
            yield from self._of_readers(flat)
            if (REPLAY, 0) in [(name, status) for name, status, _ in course.read]:
                # A start that was interrupted at once may not have come as far as the history.
                latest = WireHistory.read(run.folder / JOURNAL_FOLDER).start
                yield from wrong_recording(run.folder.parent / REPLAY_FILE, rows[latest])

    def _of_course(self, rows: Mapping[int, list[Row]], flat: list[Row]) -> Iterator[str]:
        """What must hold if nothing happens to the wire."""
        plan, words = self._plan, [typed.split() for _, typed in self._case.operations]
        changed = {link for verb, link, *_ in (each for each in words if len(each) > 1) if verb == "link"}
        joined = JOINED in self._case.further
        if OPENED in self._case.further or any(verb in {"partition", "heal"} for verb, *_ in words):
            changed = {link.name for link in plan.links}  # its opener, or an operator, cuts them
        yield from wrong_reasons(plan, flat, changed, joined=joined)
        begun = WireHistory.read(self._run.folder / JOURNAL_FOLDER).began
        yield from wrong_cuts(plan, rows[len(rows)], begun, changed)
        for some in rows.values():
            yield from wrong_rates(plan, some, changed)
        if not joined and FULL not in self._case.further:
            of_message = defaultdict[Message, list[Mapping[str, Any]]](list)
            for row in flat:
                if row["link"] is not None and row["key"] is not None:
                    of_message[self._message(row)].append(row)
            yield from wrong_arrivals(self._course, of_message)
            for some in rows.values():
                yield from wrong_order(plan, self._course, some)

    def _of_latest(self) -> Iterator[str]:
        """Commands tell of the latest start of the wire, even if that start failed."""
        with suppress(UsageError):
            latest = WireHistory.read(self._run.folder / JOURNAL_FOLDER).start
            start = summary_of_wire(self._run.folder).start
            if start != latest:
                yield f"commands tell of start {start}, and the latest start is {latest}"

    def _of_summary(self, rows: Mapping[int, list[Row]]) -> Iterator[str]:
        """The summary and the recording are those of the latest start."""
        run = self._run
        start = WireSummary.read(run.folder / WIRE_SUMMARY_FILE).start
        if start != len(rows) and not any(isinstance(fault, KillProcess | InterruptProcess) for fault in self._struck):
            yield f"the summary is that of start {start} of {len(rows)}"
        yield from wrong_summary(run.folder, rows[start], start)
        yield from wrong_counts(run.folder, rows[start], sampled="short counts" in self._case.further)
        yield from self._of_end()
        if VIEW in self._case.further and OPENED not in self._case.further:
            yield from wrong_recording(run.folder.parent / VIEW_FILE, rows[len(rows)])

    def _of_status(self, process: VirtualProcess) -> Iterator[str]:
        status = process.task.status
        interrupts = sum(isinstance(fault, InterruptProcess) for fault in self._struck)
        interrupts += OPENED in self._case.further  # its opener asks it to end
        if status == -signal.SIGKILL:
            if not any(isinstance(fault, KillProcess | CutPower) for fault in self._struck):
                yield "the wire was killed by something else"
        elif status == Interrupted.exit_status:
            if interrupts < ("interrupted again" in process.printed) + 1:
                yield f"status 130 after {interrupts} signals: {process.printed.strip()[-300:]}"
        elif any(status == wanted and words in process.printed for wanted, words in self._reasons()):
            return
        elif status != 0 and not self._disk:
            yield f"status {status}, although nothing of this may end a wire: {process.printed.strip()[-300:]}"
        elif status != 0 and not any(
            word in process.printed for word in ("cannot be", "could not be", "disk", "space")
        ):
            killed = any(isinstance(fault, CutPower) for fault in self._struck) or not process.printed
            if OPENED in self._case.further and killed:  # its opener may not have read all errors
                return
            yield f"status {status} names no disk: {process.printed.strip()[-300:]}"

    def _reasons(self) -> Iterator[tuple[int, str]]:
        """Statuses other than 0 with which a wire may end, and the words that say why."""
        if self._plan.expectations:
            yield 1, "FAILED"
        if JOINED in self._case.further:
            yield 1, "outside the wire"
        if HUNG in self._case.further:
            yield RunError.exit_status, "the wire no longer answers: nothing has moved at the side"
        if any(program.objects("peer") for program, *_ in self._course.here):
            yield 1, "past the wire"
        if MOVED in self._case.further:
            yield RunError.exit_status, "removed or moved"
            yield UsageError.exit_status, "is not empty"
            yield UsageError.exit_status, "cannot be written (No such file or directory)"

    def _of_end(self) -> Iterator[str]:
        """Nothing is left behind, the exit status tells whether expectations held, and wire.toml is the wire."""
        folder = self._run.folder
        yield from (f"{path.relative_to(folder)} is left" for path in sorted(folder.rglob("*.new")))
        if (folder / "control.json").exists():
            yield "control.json is left"
        summary = WireSummary.read(folder / WIRE_SUMMARY_FILE)
        if bool(summary.failed_expectations or summary.bypasses) != (self._run.status == 1):
            yield f"status {self._run.status} with {summary.failed_expectations} failed expectations"
        if resolved_wire(load_wire(folder / WIRE_FILE)) != resolved_wire(self._plan):
            yield "wire.toml is another wire"

    def _wrong_fates(self, rows: list[Row]) -> Iterator[str]:
        """Message n of each stream has the fate that its link's models decide, whatever happened to the wire before."""
        changed = {event.link for event in self._plan.events if event.settings is not None}
        changed |= {words.split()[1] for _, words in self._case.operations if words.startswith("link") and "=" in words}
        streams: dict[tuple[str, str, str], dict[int, Row]] = defaultdict(dict)
        for row in rows:
            if row["link"] is not None and row["n"] is not None:
                streams[row["link"], stream_of(row["kind"]), numbered_as(row["key"])][row["n"]] = row
        for (name, kind, key), of_stream in sorted(streams.items()):
            link = self._plan.named(name)
            if self._plan.is_lossless(zenoh.KeyExpr(next(iter(of_stream.values()))["key"])):
                lost = [n for n, row in of_stream.items() if row["reason"] in {"loss", "corrupted", "cut", "overflow"}]
                if lost:
                    yield f"{len(lost)} messages of {key} are lost, which must never be"
            elif name not in changed:
                yield from self._wrong_stream(link, kind, key, of_stream)

    def _too_early(self, rows: Iterable[Row]) -> Iterator[str]:
        """No message is delivered whose delay is longer than the wire was there."""
        early = []
        for row in rows:
            heard = row["time"] - EPOCH
            end = next((end for end in self._course.ended if end + _ROUNDING >= heard), 0.0)
            if row["fate"] == "delivered" and heard + row["delay"] > end + _ROUNDING:
                early.append(row)
        if early:
            yield f"the wire ended before {len(early)} messages of {early[0]['key']} that the journal calls delivered"

    def _wrong_stream(self, link: WireLink, kind: str, key: str, rows: Mapping[int, Row]) -> Iterator[str]:
        fates = fates_by_model(link, self._plan.seed, kind, key, max(rows) + 1)
        wrong, wrong_delays = [], []
        for n, row in sorted(rows.items()):
            code = WireFate(int(fates.codes[n, 0]))
            if row["reason"] in _CUT:
                continue
            if row["reason"] != REASONS.get(code) and (
                code is not WireFate.DELIVERED or row["reason"] in {"loss", "corrupted"}
            ):
                wrong.append(n)
            if row["fate"] != "delivered" or "rate" in link.settings or link.ordered:
                continue
            delay = 0.0 if fates.delays is None or fates.rests is None else float(fates.delays[n, 0] + fates.rests[n])
            again = fates.again is not None and bool(fates.again[n, 0])
            if (row["delay"], row["again"]) != (delay, again):
                wrong_delays.append(n)
        if wrong:
            yield f"{len(wrong)} fates of {key} are not those of its model, first of message {wrong[0]} on {link.name}"
        if wrong_delays:
            yield f"{len(wrong_delays)} delays of {key} are not those of its model, first of message {wrong_delays[0]}"

    def _true_to_receivers(self, rows: list[Row]) -> Iterator[str]:
        """What arrived is in the journal as delivered, and what it calls delivered has arrived, unless a fault took it."""
        got, of_message = self._course.got, defaultdict[Message, list[Row]](list)
        for row in rows:
            if row["link"] is not None and row["key"] is not None and not _is_timeout(row):
                of_message[self._message(row)].append(row)
        strangers = [
            row
            for row in rows
            if row["key"] is not None
            and (stream_of(row["kind"]), row["key"], row["size"]) not in self._course.sent
            and not _is_timeout(row)
        ]
        if strangers:
            example = min((row["key"], row["size"]) for row in strangers)
            yield f"the journal has {len(strangers)} messages that nobody sent, such as {example}"
        if twice := [message for message, some in of_message.items() if len(some) > 1 and message.kind != "reply"]:
            yield f"the journal has {len(twice)} messages twice, such as {min(twice)}"
        unwritten, wrong, often = [], defaultdict[str, list[Message]](list), []
        for message, times in sorted(got.items()):
            some = of_message.get(message, [])
            fates = {row["reason"] or "delivered" for row in some}
            if not some:
                unwritten.append(message)
            elif fates.isdisjoint({"delivered", "underway"} if self._killed else {"delivered"}):
                wrong[min(fates)].append(message)
            elif times > _copies(some):
                often.append(f"{message} arrived {times} times")
        if unwritten and not self._disk:
            yield f"{len(unwritten)} messages arrived that the journal does not have, such as {min(unwritten)}"
        for fate, messages in sorted(wrong.items()):
            yield f"{len(messages)} messages arrived that the journal calls {fate}, such as {min(messages)}"
        yield from often[:1]
        missing = [*self._missing(of_message)]
        if missing:
            yield f"{len(missing)} messages never arrived that the journal calls delivered, such as {min(missing)}"

    def _missing(self, of_message: Mapping[Message, list[Row]]) -> Iterator[tuple[str, str, int, float]]:
        """Messages that were delivered while a program was there, and that it did not get as often."""
        doubts = [*self._doubts()]
        cuts = [at for fault, at in self._struck.items() if isinstance(fault, CutPower)]  # programs ended there, too
        for message, rows in of_message.items():
            delivered = [row for row in rows if row["fate"] == "delivered"]
            if not delivered or self._course.got[message] >= _copies(delivered):
                continue
            times = [time for row in delivered for time in (row["time"] - EPOCH, row["time"] + row["delay"] - EPOCH)]
            present = any(
                since + _ARRIVING <= min(times)
                and max(times)
                <= min([end - _LEAVING for end in (*until, *cuts) if end >= since], default=self._run.seconds)
                for program, since, until in self._course.here
                if program.side == message.side and _hears(program, message.kind, message.key)
            )
            if present and not any(first <= time <= last for time in times for first, last in doubts):
                yield message.kind, message.key, message.size, round(min(times), 3)

    def _message(self, row: Row) -> Message:
        return Message(stream_of(row["kind"]), self._targets[row["link"]], row["key"], row["size"])

    def _doubts(self) -> Iterator[tuple[float, float]]:
        """When messages that the wire handed over may have been lost on their way to their reader."""
        for begun in self._course.begun[1:]:
            yield begun, begun + _DOUBT
        if self._hung:
            yield 0.0, float("inf")
        for at in self._course.dropped:
            yield at - _DROPPING, at + _ROUNDING
        for fault, at in self._struck.items():
            if isinstance(fault, SlowConnection):
                continue
            lasting = 0.0 if fault.kind in ("kill", "interrupt") or fault.target == DISK else fault.seconds
            lease = _LEASE if isinstance(fault, FreezeConnection | StopProcess) else 0.0
            yield at - 0.5, float("inf") if lasting is None else at + lasting + lease + _DOUBT

    def _wrong_senders(self, rows: list[Row]) -> Iterator[str]:
        """Messages of ROS 2 have the gid of their publisher, and its numbers."""
        gids = {ros_key(side): gid_of(ros_token(side, side, "MP")) for side in self._plan.sides}
        few = FEW_KEYS in self._case.further  # of further ones, the journal does not have the sender
        wrong = [
            row
            for row in rows
            if row["key"] in gids and row["source"] != gids[row["key"]] and not (few and row["source"] is None)
        ]
        if wrong and not self._disk:
            yield f"{len(wrong)} messages of {wrong[0]['key']} have another sender, such as {wrong[0]['source']}"

    def _of_operators(self) -> Iterator[str]:
        """What an operator asks for is done, or refused in words."""
        for words, status in self._course.typed:
            if status not in {0, UsageError.exit_status}:
                yield f"{words!r} ends with status {status}"

    def _of_readers(self, rows: list[Row]) -> Iterator[str]:
        """Check the output of commands that read the folder afterwards."""
        for words, status, said in self._course.read:
            if status not in ({0, UsageError.exit_status} if words in {"links", REPLAY} else {0}):
                yield f"{words} ends with status {status}: {said.strip()[-300:]}"
        told = "".join(said for words, _, said in self._course.read if words == "export")
        if told and f": {len(rows):,} message" not in told and not self._disk:
            yield f"the journal has {len(rows)} rows, and {told.strip()}"
        if told and not self._disk:
            yield from wrong_csv(self._run.folder.parent / "rows.csv", rows)


def _is_timeout(row: Row) -> bool:
    """Whether a reply only says that a time limit is over."""
    return bool(row["kind"] == "reply" and row["size"] == _TIMEOUT_BYTES)


def _copies(rows: Iterable[Row]) -> int:
    return sum(2 if row["again"] else 1 for row in rows)


def _numbered(rows: Mapping[int, list[Row]]) -> dict[int, list[Row]]:
    """The rows with numbers; deletions are numbered as publications, and all keys `KEY/@adv/…` as one."""
    return {
        start: [
            {**row, "kind": stream_of(row["kind"]), "key": numbered_as(row["key"])}
            for row in some
            if row["n"] is not None
        ]
        for start, some in rows.items()
    }


def _hears(program: WireProgram, kind: str, key: str) -> bool:
    """Whether a program gets messages of a kind and key."""
    if kind == "put":
        keys = program.objects("listen")
    elif kind == "query":
        keys = program.answered()
    else:
        keys = [*program.objects("ask"), *map(service, program.objects("call"))]
    return any(intersects(pattern, key) for pattern in keys)


def fates_by_model(link: WireLink, seed: int, kind: str, key: str, count: int) -> Fates:
    """What the models of a link decide about the first messages of a stream, in one go."""
    settings = {name: value for name, value in link.settings.items() if name not in ("rate", "queue")}
    schedule = LinkSchedule(settings, NEVER - 1, correlation=link.correlation)
    root = root_of_seed(seed)
    keys = {name: wire_stream_key(root, name, kind, key) for name in streams_of(link.name, schedule)}
    return Link(schedule, link.name, keys, Batch(NEVER, 1)).fates(range(count))


def _has_no_name(row: Row) -> bool:
    return str(row["key"]).startswith("unknown key ")
