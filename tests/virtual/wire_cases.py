"""Cases in which a wire is disturbed between programs in the simulated world: its journal is true to what its receivers got.

The wire is started one to three times in one folder. What must hold is what holds of real wires in `tests/faults/wires.py`,
except of what a fault may take: messages that were on their way when it struck, and records that the disk refused.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import tempfile
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import astuple, dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, final

import zenoh

from evedrop.cli.simulated import program
from evedrop.errors import EvedropError, Interrupted, UsageError
from evedrop.system.lacks import report_refusal
from evedrop.system.output import say
from evedrop.system.world import world
from evedrop.virtual import notes
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_faults import KINDS
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
from evedrop.virtual.run import SimulatedRun, SimulatedWorld
from evedrop.virtual.scheduler import Stuck
from evedrop.virtual.world import EPOCH
from evedrop.wire.file import wire_of
from evedrop.wire.journal import journal_tables
from evedrop.wire.run import run_wire
from tests.faults.programs import KEYS
from tests.faults.wires import FILE, wrong_fates, wrong_numbers, wrong_summary

EVERY = 12
"""One seed of so many is a wire."""
WIRE, ROBOT, BASE, DISK = "wire", "robot", "base", "disk"
ENDPOINTS = {ROBOT: "tcp/127.0.0.1:17501", BASE: "tcp/127.0.0.1:17502"}
_TARGETS = {"kill": (WIRE,), "interrupt": (WIRE,), "stop": (WIRE, ROBOT, BASE)}
_CONNECTIONS = dict.fromkeys(("cut", "freeze", "slow"), (ROBOT, BASE))
_DISK = {kind: (DISK,) for kind, disturbance in KINDS.items() if issubclass(disturbance, DiskDisturbance)}
_GROUPS = ((_TARGETS, 0.5), (_CONNECTIONS, 0.3), (_DISK, 0.2))
_FIRST, _PER_SECOND = 20, 80
"""Events before which no fault strikes, and about how many there are in a second."""
_PAUSE = 0.1
"""The mean time between two messages of a key."""
_AGAIN = 0.5
"""After the end of the wire, until it is started again, or its programs are asked what they got."""
_LEASE = 10.0
_DOUBT = 7.0
"""For how long after a start, or after a connection may be made again, its reader may still be away."""
_END_SECONDS = 120.0
"""In which a wire ends, besides the time for which it is started and that for which it is disturbed."""


@dataclass
class _Course:
    """What the programs of a wire saw."""

    sent: set[tuple[str, int]] = field(default_factory=set)
    got: list[tuple[str, int]] = field(default_factory=list)
    begun: list[float] = field(default_factory=list)
    """When each start of the wire began, in virtual seconds."""
    processes: list[VirtualProcess] = field(default_factory=list)
    """Of the wire's starts."""


@dataclass(frozen=True)
class PlayedWire:
    """What became of a case."""

    case: SimulatedWireCase
    run: SimulatedRun
    misses: tuple[str, ...]


@final
@dataclass(frozen=True)
class SimulatedWireCase:
    """A wire that is disturbed."""

    seed: int
    faults: tuple[Disturbance, ...]
    starts: int = 1
    seconds: float = 20.0
    """For which the wire runs in each start, unless it is ended."""

    def __str__(self) -> str:
        faults = "; ".join(map(str, self.faults)) or "no fault"
        return f"a wire, {self.starts} times for {self.seconds:g} s: {faults}"

    @classmethod
    def of(cls, seed: int) -> SimulatedWireCase:
        """The case of a seed."""
        draw = random.Random(f"wire {seed}")  # noqa: S311 - to be repeated, not to be secret
        starts, seconds = draw.choice((1, 2, 3)), draw.choice((3.0, 10.0, 20.0, 40.0))
        faults = []
        for _ in range(draw.choice((0, 1, 1, 2, 3))):
            [group] = draw.choices([group for group, _ in _GROUPS], [weight for _, weight in _GROUPS])
            kind = draw.choice(sorted(group))
            lasting = round(10.0 ** draw.uniform(-2.0, 1.3), 3) if KINDS[kind].lasts else None
            after = round(draw.uniform(_FIRST, starts * seconds * _PER_SECOND))
            faults.append(KINDS[kind](draw.choice(group[kind]), after, lasting))
        return cls(seed, tuple(faults), starts, seconds)

    @classmethod
    def read(cls, text: str) -> SimulatedWireCase:
        """The case that `to_text` has written. Raises UsageError."""
        try:
            described = json.loads(text)
            faults = tuple(KINDS[kind](*rest) for kind, *rest in described["faults"])
            return cls(described["seed"], faults, described["starts"], described["seconds"])
        except (ValueError, TypeError, KeyError) as error:
            raise UsageError(f"not a case ({type(error).__name__}: {error}); expected that of a wire") from error

    def to_text(self) -> str:
        """The case in one line."""
        faults = [[fault.kind, *astuple(fault)] for fault in self.faults]
        return json.dumps({"seed": self.seed, "faults": faults, "starts": self.starts, "seconds": self.seconds})

    def smaller(self) -> Iterator[SimulatedWireCase]:
        """The cases next to it with less of everything."""
        for i in range(len(self.faults)):
            yield SimulatedWireCase(self.seed, (*self.faults[:i], *self.faults[i + 1 :]), self.starts, self.seconds)
        for starts in range(1, self.starts):
            yield SimulatedWireCase(self.seed, self.faults, starts, self.seconds)
        for seconds in (1.0, 3.0, 10.0, 20.0):
            if seconds < self.seconds:
                yield SimulatedWireCase(self.seed, self.faults, self.starts, seconds)

    def play(self, keep: bool = False) -> PlayedWire:
        """Play it, and judge it; keep: whether to keep all events."""
        memory = Path("/dev/shm")  # noqa: S108 - folders in it are private
        folder = Path(tempfile.mkdtemp(prefix="simulated-wire-", dir=memory if memory.is_dir() else None))
        try:
            simulated = SimulatedWorld(self.seed, program, folder, keep)
            course, struck = _Course(), dict[Disturbance, float]()
            for fault in self.faults:
                simulated.scheduler.after(fault.after, partial(_strike, fault, simulated, struck))
            run = SimulatedRun(simulated.disk.root / "wire")
            self._carry_out(simulated, course, run)
            judge = _Judge(self, course, run, struck)
            return PlayedWire(self, run, tuple(judge.misses()))
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _carry_out(self, simulated: SimulatedWorld, course: _Course, run: SimulatedRun) -> None:
        scheduler = simulated.scheduler
        numbers = count(1)
        longest = self.seconds + _END_SECONDS + sum(fault.seconds or 0.0 for fault in self.faults)
        with simulated.entered():
            try:
                for _ in range(self.starts):
                    course.begun.append(scheduler.now)
                    wire = simulated.machine.begin(WIRE, partial(_wire, run.folder, self.seconds))
                    course.processes.append(wire)
                    for name, work in ((BASE, _listen), (ROBOT, partial(_send, numbers))):
                        if simulated.process(name) is None:
                            simulated.machine.begin(name, partial(work, course))
                    scheduler.run(scheduler.now + longest, lambda wire=wire: not wire.task.alive)  # type: ignore[misc]
                    simulated.disk.make_room()
                    moment = scheduler.now + _AGAIN
                    scheduler.at(moment, lambda: None)
                    scheduler.run(moment + 1.0, lambda moment=moment: scheduler.now >= moment)  # type: ignore[misc]
            except Stuck as why:
                run.stuck = str(why)
            run.status, run.said = course.processes[-1].task.status, "".join(one.printed for one in course.processes)
            run.errors, run.seconds, run.events = scheduler.errors, scheduler.now, scheduler.events
            run.digest, run.happened = scheduler.digest, scheduler.happened


@final
class _Judge:
    """Says what must hold and does not."""

    def __init__(
        self, case: SimulatedWireCase, course: _Course, run: SimulatedRun, struck: dict[Disturbance, float]
    ) -> None:
        self._case, self._course, self._run, self._struck = case, course, run, struck
        self._disk = any(isinstance(fault, DiskDisturbance) for fault in struck)

    def misses(self) -> Iterator[str]:
        """The broken promises."""
        run, course = self._run, self._course
        if run.stuck is not None:
            yield f"stuck: {run.stuck}"
            return
        yield from (f"{thread}: {type(error).__name__}: {error}" for thread, error in run.errors)
        yield from (line for line in run.said.splitlines() if "Traceback" in line or "report this" in line)
        for process in course.processes:
            yield from self._of_status(process)
        try:
            starts = range(1, len(course.begun) + 1)
            rows = {
                number: [row for table in journal_tables(run.folder, number, True) for row in table.to_pylist()]
                for number in starts
            }
        except UsageError as error:
            if not self._disk:
                yield f"the journal cannot be read: {error}"
            return
        yield from wrong_fates(rows)
        if not self._disk:
            yield from wrong_numbers(rows)
        yield from self._true_to_receivers([row for some in rows.values() for row in some if row["key"] in KEYS])
        if run.status == 0 and not self._disk:
            yield from wrong_summary(run.folder, rows[len(rows)], len(rows))
            if (run.folder / "control.json").exists():
                yield "control.json is left"

    def _of_status(self, process: VirtualProcess) -> Iterator[str]:
        status = process.task.status
        interrupts = sum(isinstance(fault, InterruptProcess) for fault in self._struck)
        if status == -signal.SIGKILL:
            if not any(isinstance(fault, KillProcess | CutPower) for fault in self._struck):
                yield "the wire was killed by something else"
        elif status == Interrupted.exit_status:
            if interrupts < 2:
                yield "status 130, but no second signal asked for the end"
        elif status != 0 and not self._disk:
            yield f"status {status}, although nothing of this may end a wire: {process.printed.strip()[-300:]}"
        elif status != 0 and not any(word in process.printed for word in ("cannot be", "disk", "space")):
            yield f"status {status} names no disk: {process.printed.strip()[-300:]}"

    def _true_to_receivers(self, rows: list[dict[str, Any]]) -> Iterator[str]:
        """What arrived is in the journal as delivered, and what it calls delivered has arrived, unless a fault took it."""
        got = Counter(self._course.got)
        if twice := [message for message, times in got.items() if times > 1]:
            yield f"{twice[0]} arrived {got[twice[0]]} times"
        fates = defaultdict(set)
        for row in rows:
            fates[row["reason"] or "delivered"].add((row["key"], row["size"]))
        heard = set().union(*fates.values())
        if strangers := heard - self._course.sent:
            yield f"the journal has {len(strangers)} messages that nobody sent, such as {min(strangers)}"
        if len(heard) != len(rows):
            yield f"the journal has {len(rows) - len(heard)} messages twice"
        if not self._disk and (unwritten := set(got) - heard):
            yield f"{len(unwritten)} messages arrived that the journal does not have, such as {min(unwritten)}"
        killed = any(isinstance(fault, KillProcess) for fault in self._struck) or self._disk
        for fate in fates.keys() - {"delivered"} - ({"underway"} if killed else set()):
            if wrong := fates[fate] & set(got):
                yield f"{len(wrong)} messages arrived that the journal calls {fate}, such as {min(wrong)}"
        doubts = [*self._doubts()]
        missing = [
            (row["key"], row["size"], round(due, 3))
            for row in rows
            if row["fate"] == "delivered" and (row["key"], row["size"]) not in got
            for due in [row["time"] + row["delay"] - EPOCH]
            if not any(first <= due <= last for first, last in doubts)
        ]
        if missing:
            yield f"{len(missing)} messages never arrived that the journal calls delivered, such as {min(missing)}"
        if not rows and not self._struck:
            yield "the journal has no message"

    def _doubts(self) -> Iterator[tuple[float, float]]:
        """When messages that the wire handed over may have been lost on their way to their reader."""
        for begun in self._course.begun:
            yield begun, begun + _DOUBT
        for fault, at in self._struck.items():
            if isinstance(fault, SlowConnection):
                continue
            lasting = 0.0 if fault.kind in ("kill", "interrupt") or fault.target == DISK else fault.seconds
            lease = _LEASE if isinstance(fault, FreezeConnection | StopProcess) else 0.0
            yield at - 0.5, float("inf") if lasting is None else at + lasting + lease + _DOUBT


def _strike(fault: Disturbance, simulated: SimulatedWorld, struck: dict[Disturbance, float]) -> None:
    simulated.scheduler.note(notes.FAULT, str(fault))
    if fault.strike(simulated):
        struck[fault] = simulated.scheduler.now


def _wire(folder: Path, seconds: float) -> int:
    """The wire, as the command runs it."""
    tables = tomllib.loads(FILE)
    for side, endpoint in ENDPOINTS.items():
        tables["side"][side] = {"listen": endpoint}
    try:
        return run_wire(wire_of(tables), folder, seconds=seconds, say=lambda _: None, complain=say)
    except EvedropError as error:
        say(error.illustrated)
        return error.exit_status
    except OSError as error:
        return report_refusal(error)


def connected(endpoint: str) -> Any:
    """A session at a side of a wire, once it listens there."""
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
    while True:
        try:
            return world().zenoh.open(config)
        except zenoh.ZError:
            world().sleep(0.1)


def _listen(course: _Course) -> int:
    """The program at the base."""
    session = connected(ENDPOINTS[BASE])
    for key in KEYS:
        session.declare_subscriber(key, lambda sample, key=key: course.got.append((key, len(sample.payload))))
    while True:
        world().sleep(100.0)


def _send(numbers: Iterator[int], course: _Course) -> int:
    """The program at the robot: the length of a message is its number."""
    session = connected(ENDPOINTS[ROBOT])
    for number in numbers:
        for key in KEYS:
            course.sent.add((key, number))
            session.put(key, bytes(number), congestion_control=zenoh.CongestionControl.BLOCK)
        world().sleep(2.0 * _PAUSE * world().token(1)[0] / 256.0)
    return 0
