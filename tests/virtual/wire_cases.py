"""Cases in which a wire is disturbed between programs in the simulated world: its journal is true to what its receivers got.

The wire is the command, with a file that is drawn, and is started one to three times in one folder; or files with
mistakes are refused.
Afterwards other commands read the folder.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import json
import random
import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, final
from unittest.mock import patch

from evedrop.cli.simulated import program
from evedrop.errors import UsageError
from evedrop.scenario.words import toml_text
from evedrop.virtual import notes
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_faults import KINDS
from evedrop.virtual.faults import DiskDisturbance, FreezeConnection, StopProcess
from evedrop.virtual.run import SimulatedRun, SimulatedWorld
from evedrop.virtual.scheduler import Stuck, VirtualScheduler
from evedrop.virtual.world import EPOCH
from evedrop.wire.file import wire_of
from tests.faults.wires import FILE
from tests.virtual.small_limits import FULL, small_limits
from tests.virtual.wire_commands import (
    DAMAGED,
    FURTHER,
    JOINED,
    MOVED,
    OPENED,
    SCENARIO,
    VIEW,
    join,
    move_journal,
    readers,
    route,
    run_the_wire,
    type_words,
)
from tests.virtual.wire_damage import tried_damages
from tests.virtual.wire_draws import (
    BASE,
    ENDPOINTS,
    OUTSIDE,
    ROBOT,
    Tables,
    drawn_operations,
    drawn_programs,
    file_of,
    without_a_part,
)
from tests.virtual.wire_judge import DISK, WireJudge
from tests.virtual.wire_mistakes import TRIALS, tried
from tests.virtual.wire_opener import open_from_python
from tests.virtual.wire_programs import Course, ProgramAtWork, WireProgram, programs_of
from tests.virtual.wire_scenarios import play_over_wire

EVERY = 12
"""One seed of so many is a wire."""
WIRE = "wire"
_TARGETS = {"kill": (WIRE,), "interrupt": (WIRE,), "stop": (WIRE, ROBOT, BASE)}
_CONNECTIONS = dict.fromkeys(("cut", "freeze", "slow"), (ROBOT, BASE))
_DISK = {kind: (DISK,) for kind, disturbance in KINDS.items() if issubclass(disturbance, DiskDisturbance)}
_GROUPS = ((_TARGETS, 0.5), (_CONNECTIONS, 0.3), (_DISK, 0.2))
_FIRST, _PER_SECOND = 20, 80
"""Events before which no fault strikes, and about how many there are in a second."""
_BROKEN = 0.15
"""The fraction of cases that only try what may be in a file."""
_TRIALS = 40
"""How many of it each of them tries."""
_AGAIN = 0.5
"""After the end of the wire, until it is started again, or its programs are asked what they got."""
_END_SECONDS = 120.0
"""In which a wire ends, besides the time for which it is started and that for which it is disturbed."""
_READ_SECONDS = 60.0
_FILE = "robot.toml"


def _usual_file() -> str:
    tables = tomllib.loads(FILE)
    for side in (ROBOT, BASE):
        tables["side"][side] = {"listen": ENDPOINTS[side]}
    return toml_text(tables)


USUAL_FILE = _usual_file()
USUAL_PROGRAMS = (
    WireProgram(BASE, ("listen scan", "listen slow")),
    WireProgram(ROBOT, ("publish scan", "publish slow")),
)


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
    file: str = USUAL_FILE
    programs: tuple[WireProgram, ...] = USUAL_PROGRAMS
    operations: tuple[tuple[float, str], ...] = ()
    """What operators type, and how many seconds after the first start."""
    trials: tuple[str, ...] = ()
    """What is put into the file, once each, in words of `TRIALS`; then no wire is run."""
    further: tuple[str, ...] = ()
    """What else is done, in words of `FURTHER`."""

    def __str__(self) -> str:
        if self.trials:
            return f"a wire whose file has {', '.join(self.trials)}"
        faults = "; ".join(map(str, self.faults)) or "no fault"
        typed = "".join(f"; at {at:g} s: {words}" for at, words in self.operations)
        typed += "".join(f"; {what}" for what in self.further)
        return (
            f"a wire, {self.starts} times for {self.seconds:g} s: {faults}{typed}; {'; '.join(map(str, self.programs))}"
        )

    @property
    def tables(self) -> Tables:
        """Those of its file, without what is tried."""
        return tomllib.loads(self.file)

    @classmethod
    def of(cls, seed: int) -> SimulatedWireCase:
        """The case of a seed."""
        draw = random.Random(f"wire {seed}")  # noqa: S311 - to be repeated, not to be secret
        starts, seconds = draw.choice((1, 1, 2, 3)), draw.choice((2.0, 4.0, 6.0, 12.0))
        tables = file_of(draw, seconds)
        file = toml_text(tables)
        if draw.random() < _BROKEN:
            return cls(seed, (), 1, seconds, file, (), (), tuple(draw.sample(TRIALS, _TRIALS)))
        programs = drawn_programs(draw, tables, seconds)
        operations = drawn_operations(draw, tables, seconds)
        faults = _faults(draw, starts * seconds)
        drawn = [what for what, chance in FURTHER.items() if draw.random() < chance]
        # Messages go round between sides that are joined outside: if links duplicate them, there are millions.
        duplicates = "duplicate" in file or any("duplicate" in words for _, words in operations)
        further = tuple(what for what in drawn if not (duplicates and what == JOINED))
        if FULL in further:  # so that something waits
            stops = draw.choice((FreezeConnection, StopProcess))
            faults += (stops(BASE, round(draw.uniform(_FIRST, _PER_SECOND)), round(draw.uniform(1.0, 12.0), 2)),)
        return cls(seed, faults, starts, seconds, file, programs, operations, (), further)

    @classmethod
    def read(cls, text: str) -> SimulatedWireCase:
        """The case that `to_text` has written. Raises UsageError."""
        try:
            described = json.loads(text)
            faults = tuple(KINDS[kind](*rest) for kind, *rest in described["faults"])
            case = cls(described["seed"], faults, described["starts"], described["seconds"])
            case = replace(case, further=tuple(described.get("further", ())))
            if "file" in described:
                operations = tuple((at, words) for at, words in described["operations"])
                programs, trials = programs_of(described["programs"]), tuple(described["trials"])
                case = replace(case, file=described["file"], programs=programs, operations=operations, trials=trials)
        except (ValueError, TypeError, KeyError) as error:
            raise UsageError(f"not a case ({type(error).__name__}: {error}); expected that of a wire") from error
        return case

    def to_text(self) -> str:
        """The case in one line."""
        faults = [[fault.kind, *astuple(fault)] for fault in self.faults]
        described: dict[str, Any] = {
            "seed": self.seed,
            "faults": faults,
            "starts": self.starts,
            "seconds": self.seconds,
        }
        if (self.file, self.programs, self.operations, self.trials) != (USUAL_FILE, USUAL_PROGRAMS, (), ()):
            programs = [
                {"side": drawn.side, "does": drawn.does, "after": drawn.after, "until": drawn.until}
                for drawn in self.programs
            ]
            described |= {
                "file": self.file,
                "programs": programs,
                "operations": self.operations,
                "trials": self.trials,
            }
        if self.further:
            described["further"] = self.further
        return json.dumps(described)

    def smaller(self) -> Iterator[SimulatedWireCase]:
        """The cases next to it with less of everything."""
        for i in range(len(self.faults)):
            yield replace(self, faults=(*self.faults[:i], *self.faults[i + 1 :]))
        for starts in range(1, self.starts):
            yield replace(self, starts=starts)
        for seconds in (1.0, 3.0, 10.0, 20.0):
            if seconds < self.seconds:
                yield replace(self, seconds=seconds)
        for i in range(len(self.trials) if len(self.trials) > 1 else 0):
            yield replace(self, trials=(*self.trials[:i], *self.trials[i + 1 :]))
        for i in range(len(self.further)):
            yield replace(self, further=(*self.further[:i], *self.further[i + 1 :]))
        for i in range(len(self.operations)):
            yield replace(self, operations=(*self.operations[:i], *self.operations[i + 1 :]))
        yield from (replace(self, programs=fewer) for fewer in self._fewer_programs())
        if self.file != USUAL_FILE:
            for tables in without_a_part(self.tables):
                sides = tables["side"]
                programs = tuple(drawn for drawn in self.programs if drawn.side in sides)
                yield replace(self, file=toml_text(tables), programs=programs)

    def _fewer_programs(self) -> Iterator[tuple[WireProgram, ...]]:
        if self.programs == USUAL_PROGRAMS:
            return
        for i, drawn in enumerate(self.programs):
            before, after = self.programs[:i], self.programs[i + 1 :]
            yield (*before, *after)
            for at in range(len(drawn.does)):
                yield (*before, replace(drawn, does=(*drawn.does[:at], *drawn.does[at + 1 :])), *after)
            if drawn.after or drawn.until is not None:
                yield (*before, replace(drawn, after=0.0, until=None), *after)

    def play(self, keep: bool = False) -> PlayedWire:
        """Play it, and judge it; keep: whether to keep all events."""
        misses: tuple[str, ...] = ()
        if SCENARIO in self.further:
            played, misses = play_over_wire(self.tables, self.seed, keep)
            if played is not None:
                return PlayedWire(self, played.run, misses)
        memory = Path("/dev/shm")  # noqa: S108 - folders in it are private
        folder = Path(tempfile.mkdtemp(prefix="simulated-wire-", dir=memory if memory.is_dir() else None))
        try:
            simulated = SimulatedWorld(self.seed, program, folder, keep)
            course, struck = Course(), dict[Disturbance, float]()
            for fault in self.faults:
                simulated.scheduler.after(fault.after, partial(_strike, fault, simulated, struck))
            simulated.scheduler.watchers.append(partial(_note_drop, simulated.scheduler, course))
            run = SimulatedRun(simulated.disk.root / "wire")
            if self.trials:
                return PlayedWire(self, run, self._tried(simulated, run))
            (simulated.disk.root / _FILE).write_text(self.file, "utf-8")
            with small_limits(self.further), patch.object(tempfile, "tempdir", str(simulated.disk.root)):
                self._carry_out(simulated, course, run)
                judge = WireJudge(self, wire_of(self.tables), course, run, struck)
                return PlayedWire(self, run, (*misses, *judge.misses()))
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _tried(self, simulated: SimulatedWorld, run: SimulatedRun) -> tuple[str, ...]:
        """Give the command files with mistakes; returns the misses."""
        with simulated.entered():
            try:
                misses = [*tried(simulated, simulated.disk.root / _FILE, self.file, self.tables, self.trials)]
            except Stuck as why:
                misses = [f"stuck: {why}"]
        _note_the_end(simulated, run)
        return (*misses, *(f"{thread}: {type(error).__name__}: {error}" for thread, error in run.errors))

    def _carry_out(self, simulated: SimulatedWorld, course: Course, run: SimulatedRun) -> None:
        scheduler, begin = simulated.scheduler, simulated.machine.begin
        longest = self.seconds + _END_SECONDS + sum(fault.seconds or 0.0 for fault in self.faults)
        file = simulated.disk.root / _FILE
        opened = OPENED in self.further
        work_of_wire = partial(run_the_wire, file, run.folder, self.seconds, view=VIEW in self.further)
        sides = self.tables["side"]
        every = len(self.programs)  # no two messages have the same number
        numbers = {drawn: count(first, every) for first, drawn in enumerate(self.programs, 1)}
        with simulated.entered():
            try:
                if any("connect" in side for side in sides.values()):
                    begin("router", route)
                if JOINED in self.further:
                    joining = partial(join, [*sides.values()], self.seconds / 2.0)
                    scheduler.at(self.seconds / 4.0, partial(begin, "joining", joining))
                if MOVED in self.further:
                    scheduler.at(self.seconds / 2.0, partial(begin, "mover", partial(move_journal, run.folder)))
                for at, typed in self.operations:
                    scheduler.at(at, partial(begin, "operator", partial(type_words, run.folder, typed, course)))
                for _ in range(self.starts):
                    course.begun.append(scheduler.now)
                    if opened:
                        work = partial(
                            open_from_python, file, run.folder, self.seconds, WIRE, simulated.machine, course
                        )
                        wire = begin("opener", work)
                    else:
                        wire = begin(WIRE, work_of_wire)
                        course.processes.append(wire)
                    for place, drawn in enumerate(self.programs):
                        if simulated.process(drawn.side) is None:
                            side = sides[drawn.side]
                            endpoint = OUTSIDE if "connect" in side else ENDPOINTS[drawn.side]
                            at_work = ProgramAtWork(drawn, place, numbers[drawn], course)
                            begin(drawn.side, partial(at_work.run, endpoint, side.get("users"), EPOCH))
                    scheduler.run(scheduler.now + longest, lambda wire=wire: not wire.task.alive)  # type: ignore[misc]
                    course.ended.append(scheduler.now)
                    simulated.disk.make_room()
                    moment = scheduler.now + _AGAIN
                    scheduler.at(moment, lambda: None)
                    scheduler.run(moment + 1.0, lambda moment=moment: scheduler.now >= moment)  # type: ignore[misc]
                self._read(simulated, course, run.folder)
                if DAMAGED in self.further and not any(isinstance(fault, DiskDisturbance) for fault in self.faults):
                    course.damaged += tried_damages(simulated, run.folder, self.tables, self.seed)
            except Stuck as why:
                run.stuck = str(why)
            run.status = course.processes[-1].task.status if course.processes else None
            run.said = "".join(process.printed for process in course.processes)
        _note_the_end(simulated, run)

    def _read(self, simulated: SimulatedWorld, course: Course, folder: Path) -> None:
        """Let commands read the folder."""
        for name, work in readers(folder, folder.parent / _FILE, wire_of(self.tables), self.seed, self.further):
            reader = simulated.machine.begin("reader", work)
            now = simulated.scheduler.now
            simulated.scheduler.run(now + _READ_SECONDS, lambda reader=reader: not reader.task.alive)  # type: ignore[misc]
            course.read.append((name, reader.task.status or 0, reader.printed))


def _note_the_end(simulated: SimulatedWorld, run: SimulatedRun) -> None:
    scheduler = simulated.scheduler
    run.errors, run.seconds, run.events = scheduler.errors, scheduler.now, scheduler.events
    run.digest, run.happened = scheduler.digest, scheduler.happened


def _faults(draw: random.Random, seconds: float) -> tuple[Disturbance, ...]:
    faults = []
    for _ in range(draw.choice((0, 0, 1, 1, 2, 3))):
        [group] = draw.choices([group for group, _ in _GROUPS], [weight for _, weight in _GROUPS])
        kind = draw.choice(sorted(group))
        lasting = round(10.0 ** draw.uniform(-2.0, 1.3), 3) if KINDS[kind].lasts else None
        after = round(draw.uniform(_FIRST, seconds * _PER_SECOND))
        faults.append(KINDS[kind](draw.choice(group[kind]), after, lasting))
    return tuple(faults)


def _note_drop(scheduler: VirtualScheduler, course: Course, name: str, what: str, words: tuple[object, ...]) -> None:
    del name
    if what == notes.LOST and words[-1] == notes.NO_ROOM:
        course.dropped.append(scheduler.now)


def _strike(fault: Disturbance, simulated: SimulatedWorld, struck: dict[Disturbance, float]) -> None:
    simulated.scheduler.note(notes.FAULT, str(fault))
    if fault.strike(simulated):
        struck[fault] = simulated.scheduler.now
