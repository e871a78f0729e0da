"""Somebody who does something beside a run: writes briefs and breaks some, starts their processes, or gives wrong options.

Source: docs/hosts.md, processes started by hand.
"""

from __future__ import annotations

import gc
import json
import os
import random
import re
import signal
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, final

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.live.launch.hosts_file import load_hosts, processes_of
from evedrop.live.launch.launcher import launch
from evedrop.live.network.connection import VARIABLE
from evedrop.names import LEGITIMATE, RECORDER, ROUTER, SENSOR
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.disturbance import KILLED, Disturbance
from evedrop.virtual.drawn_hosts import MISTAKES, DrawnHost, DrawnHosts
from evedrop.virtual.drawn_scenarios import scenario_of
from evedrop.virtual.endings import status_of
from evedrop.virtual.notes import BY_HAND
from evedrop.virtual.programs import FORMS, DrawnProgram

if TYPE_CHECKING:
    from evedrop.virtual.processes import VirtualProcess
    from evedrop.virtual.run import SimulatedWorld

_PORT = 20_000
_AT, _RELAY_AT = "tls/127.0.0.1:{port}", "tls/127.0.0.1:{relay_port}"
_OPTIONS: Mapping[str, Sequence[str]] = {
    "briefs": ("--listen", _AT),
    "unencrypted briefs": ("--listen", "tcp/127.0.0.1:{port}"),
    "briefs for a host": ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}", "--insecure"),
    "briefs for an unknown host": (
        *("--listen", "tcp/unknown:{port}", "--connect", "tcp/unknown:{port}", "--insecure", "--wait", "4"),
    ),
}
"""What is written → the options for it, in a run with one router; with two, those of the relay are added."""
_WRONG_OPTIONS: Sequence[Sequence[str]] = (
    ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}"),
    ("--listen", "tls/0.0.0.0:{port}"),
    ("--listen", _AT, "--connect", "tcp/router.lan:{port}"),
    ("--listen", "tls/[fd00::1]:{port}"),
    ("--listen", "nowhere"),
    ("--listen", _AT, "--relay-connect", _RELAY_AT),
    ("--listen", _AT, "--relay", _AT),
    ("--listen", _AT, "--relay", "tcp/127.0.0.1:{relay_port}"),
)
"""Options that are refused for each scenario."""
_REFUSED, _CONTAINERS = "briefs with wrong options", "files for containers"
_AGAIN = (
    (("{own}", "{folder}"), UsageError.exit_status),
    (("{own}", "{folder}", "--overwrite", "--set", "title=Other"), UsageError.exit_status),
    (("{own}", "{folder}", "--overwrite"), 0),
    (("eavesdroppers", "{folder}", "--overwrite"), 0),
    (("eavesdroppers", "{folder}", "--overwrite", "--set", "slots=9"), 0),
)
"""What is written over files for containers: scenario, folder and options; and the exit status."""
_TOO_LARGE = 2**30 + 1
_WAIT_SECONDS, _POLL_SECONDS = "1", 0.2
_LACKS = ("No space left on device", "Input/output error", "not enough memory", "no further process or thread")
_PATIENCE_SECONDS, _SOON_SECONDS = 10.0, 0.2
"""For a process to end by itself; most are told to end soon, once they must have read their briefs."""
_SCENARIOS, _STARTED, _STARTING_SECONDS = 3, 30, 30.0
"""For how many scenarios files are written, how many processes of each are started, and for how long in all."""
_CLOCKS = (-90.0 * 86_400.0, 90.0 * 86_400.0)
"""By how many seconds a clock is wrong, so that no certificate is valid."""
_PATHS = frozenset({"last_word", "modules", "results", "state_file"})
"""Entries with a path: another one would be outside the simulated disk."""
_WRONG: Sequence[Any] = (None, True, -1, 2**70, float("inf"), "", "x", "/nowhere", [], {}, [[1.0]], {"scheme": "x"})
"""What an entry of a brief is replaced with."""
_IS_ENDPOINT, _ENDPOINTS = (
    re.compile("t(cp|ls)/"),
    ("unixsock-stream/x", "unixsock-stream//x", "unixsock-stream//tmp/x", f"unixsock-stream//{'x' * 200}"),
)
"""What is an endpoint, and places at which nobody can listen."""
Brief = dict[str, Any]


class ByHand(Disturbance):
    """Somebody does something beside the run, in a folder of its own."""

    harmless = True
    drawn: ClassVar[Sequence[str]]
    """What it may be in any run; what stands there twice is drawn twice as often."""

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All that it may be."""
        del scenario
        return cls.drawn

    def strike(self, world: SimulatedWorld) -> bool:
        """Let somebody do it, who gives up if the disk does not take it."""

        def act() -> int:
            scenario, folder = world.scenario, world.disk.root / f"by hand {self.after}"
            with suppress(OSError):
                if scenario is not None and not folder.exists():
                    folder.mkdir(0o700)
                    self._act(world, scenario, folder)
                return 0
            return 1

        world.machine.begin("somebody", act)
        return True

    @abstractmethod
    def _act(self, world: SimulatedWorld, scenario: Scenario, folder: Path) -> None:
        """Do it with the run's scenario, or others, in a folder. Raises OSError."""


@final
class WriteBriefs(ByHand):
    """`evedrop brief`, and a process that is started with one of the briefs, in which an entry may be wrong."""

    kind, share = "write", 5
    awaited_seconds = 60.0
    drawn = (*[*_OPTIONS] * 3, _CONTAINERS, _CONTAINERS, _REFUSED, _REFUSED)

    def _act(self, world: SimulatedWorld, scenario: Scenario, folder: Path) -> None:
        some, deadline = random.Random(here().token(8)), here().monotonic() + _STARTING_SECONDS  # noqa: S311 - to be repeated
        for number, written in enumerate(_with_others(scenario, some)):
            own = folder / str(number)
            own.mkdir(0o700)
            write_resolved(own, written)
            self._write(world, written, own, some, deadline)

    def _write(
        self, world: SimulatedWorld, scenario: Scenario, folder: Path, some: random.Random, deadline: float
    ) -> None:
        """Write what is to be written for a scenario, which is in a folder, and use it until a deadline."""
        if self.target == _CONTAINERS:
            refused = _by_launcher(scenario) or scenario.modules is not None or scenario.process.source == "zenoh"
            if self._written(world, folder, ["--compose"], refused=refused):
                self._check_containers(world, scenario, folder / "written")
        elif self.target == _REFUSED:
            for options in (*_WRONG_OPTIONS, *([("--listen", _AT)] if scenario.relayed else [])):
                self._written(world, folder, options, refused=True)
        elif self._written(world, folder, self._options(scenario), refused=_by_launcher(scenario)):
            paths = sorted((folder / "written").glob("*.json"))
            self._start_some(world, {path: json.loads(path.read_text()) for path in paths}, some, deadline)

    def _written(self, world: SimulatedWorld, folder: Path, options: Sequence[str], *, refused: bool) -> bool:
        """Write files with these options; returns whether they are there."""
        words, port = ["brief", str(folder / "scenario.toml")], _PORT + 2 * self.after % _PORT
        if "--listen" in options:
            words += ["--wait", _WAIT_SECONDS, "--results", str(folder / "results")]
            options = [*options, "--out"]
        words += [*(option.format(port=port, relay_port=port + 1) for option in options), str(folder / "written")]
        status = world.machine.program(words)
        expected = UsageError.exit_status if refused else 0
        printed = world.machine.current.printed
        if status != expected and not _is_lacking(printed):
            raise AssertionError(
                f"to write {self.target} with {' '.join(options)} ends with status {status}: {printed[-300:]}"
            )
        return status == 0

    def _options(self, scenario: Scenario) -> Sequence[str]:
        options = _OPTIONS[self.target]
        if not scenario.relayed:
            return options
        options = [*options, "--relay", options[1].replace("{port}", "{relay_port}")]
        if "--connect" in options:
            options += ["--relay-connect", options[3].replace("{port}", "{relay_port}")]
        return options

    @staticmethod
    def _check_containers(world: SimulatedWorld, scenario: Scenario, written: Path) -> None:
        """A container is for each process, and files are written over others only if that is asked for, and possible."""
        text = (written / "docker-compose.yml").read_text()
        lacking = [name for name in (ROUTER, *scenario.receivers) if f"{name}:" not in text]
        if lacking:
            raise AssertionError(f"no container is for {', '.join(lacking)}")
        for words, expected in _AGAIN:
            own, folder, *options = (word.format(own=written / "scenario.toml", folder=written) for word in words)
            status = world.machine.program(["brief", own, "--compose", folder, *options])
            if status != expected:
                raise AssertionError(f"files for containers of {own} end with status {status}: {' '.join(options)}")

    @staticmethod
    def _start_some(world: SimulatedWorld, briefs: Mapping[Path, Brief], some: random.Random, deadline: float) -> None:
        """Start processes with briefs in which an entry is wrong, each kind of entry as often as any other."""
        of_kind: dict[str, list[tuple[Path, list[Any]]]] = {}
        for path, brief in briefs.items():
            for place in _places(brief):
                of_kind.setdefault(str(next(name for name in reversed(place) if name != 0)), []).append((path, place))
        for _ in range(_STARTED):
            if here().monotonic() > deadline:
                return
            path, place = some.choice(of_kind[some.choice([*of_kind])])
            brief, role, clock, chance = deepcopy(briefs[path]), briefs[path]["role"], 0.0, some.random()
            if chance < 0.03:
                clock = some.choice(_CLOCKS)
            elif chance < 0.11:
                _exchange(some, brief, some.choice([*briefs.values()]))
            elif chance < 0.14:
                role = some.choice([*briefs.values()])["role"]
            elif chance > 0.15:
                _break(some, brief, place)
            path.write_text(json.dumps(brief))
            if chance > 0.99:
                os.truncate(path, _TOO_LARGE)
            path.chmod(0o644 if some.random() < 0.03 else 0o600)
            _start(world, role, path, clock, some.choice((*[_SOON_SECONDS] * 4, _PATIENCE_SECONDS)))
            path.write_text(json.dumps(briefs[path]))


def _is_lacking(printed: str) -> bool:
    """Whether a command says that the disk or the machine lacks something."""
    return any(lack in printed for lack in _LACKS)


def _by_launcher(scenario: Scenario) -> bool:
    """Whether only a launcher can run a scenario: it is in shards, or processes are killed or suspended."""
    return scenario.shards > 1 or any(act.effect.action is not None for act in scenario.timeline.acts)


def _any_scenario(some: random.Random) -> Scenario:
    """A drawn scenario; if it has given states, a program at which the sensor connects has them."""
    scenario = scenario_of(some.getrandbits(32))
    if scenario.process.source != "file":
        return scenario
    return DrawnProgram(listens=True, form=some.choice(FORMS)).scenario(scenario)


def _with_others(scenario: Scenario, some: random.Random) -> list[Scenario]:
    """The scenario of the run, and drawn ones."""
    return [scenario, *(_any_scenario(some) for _ in range(1, _SCENARIOS))]


def _start(world: SimulatedWorld, role: str, path: Path, clock: float, patience: float) -> None:
    """Start a process with a brief that is wrong, or where a clock is; it ends, and says why, or is told to end."""
    process = world.machine.begin(BY_HAND, lambda: world.machine.program([role, str(path)]))
    process.task.clock = clock
    for seconds, sign in ((patience, signal.SIGTERM), (_PATIENCE_SECONDS, signal.SIGKILL)):
        deadline = here().monotonic() + seconds
        while process.task.status is None and here().monotonic() < deadline:
            here().sleep(_POLL_SECONDS)
        process.signal(sign)  # the wrong entry may be how long it waits for others
    ended = process.task.status in {UsageError.exit_status, RunError.exit_status, Interrupted.exit_status, KILLED}
    if not ended or "Traceback" in process.printed:
        raise AssertionError(
            f"{role} ends with status {process.task.status} because of a wrong brief: {process.printed[-500:]}"
        )


def _exchange(some: random.Random, brief: Brief, other: Brief) -> None:
    """Let a brief have the identity of another process, or the key of its identity, or the keys of its random streams."""
    mine, its = brief.get("identity"), other.get("identity")
    if mine is None or its is None or some.random() < 0.3:
        brief["keys"] = other["keys"]
    elif some.random() < 0.5:
        brief["identity"] = its
    else:
        mine["key"] = its["key"]


def _places(table: Any) -> Iterator[list[Any]]:
    """The names that lead to each entry of a brief; the first one of a list stands for all, and a scenario for its entries.

    So do the answers of classes: simulated processes share what they have learned of them.
    """
    for name in [*table] if isinstance(table, dict) else [0] if isinstance(table, list) and table else []:
        yield [name]
        if name not in {"scenario", "classes"}:
            for rest in _places(table[name]):
                yield [name, *rest]


def _break(some: random.Random, brief: Brief, place: Sequence[Any]) -> None:
    """Let an entry of a brief be wrong, lack or be too many."""
    *path, last = place
    table: Any = brief
    for name in path:
        table = table[name]
    chance = some.random()
    if chance < 0.15:
        del table[last]
    elif chance < 0.25:
        table[last] = None
    elif last in _PATHS:
        table[last] = some.choice([value for value in _WRONG if not isinstance(value, str)])
    else:
        table[last] = some.choice(_others(table[last]) if some.random() < 0.8 else _WRONG)


def _others(value: Any) -> Sequence[Any]:
    """Other values of the same type."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int | float):
        return [value + 1, -1, 0, 1e300]
    if isinstance(value, str):
        return ["x", value[1:], *(_ENDPOINTS if _IS_ENDPOINT.match(value) else [])]
    if isinstance(value, list) and value:
        return [value[:-1], [*value, value[-1]]]
    if isinstance(value, dict) and value:
        return [{**value, "unknown": 1}, dict(list(value.items())[1:])]
    return _WRONG


_MOST_SLOTS = 40
_RUN_SECONDS = 40.0
_PAUSED = "a run that begins paused"
_RECORDED, _RECORDING = "a run that is recorded for views", b"RRF2"
"""How Rerun's files begin."""
_INTERRUPTED, _STRANGE, _WRONG_CLOCK, _TAKEN = (
    *("a run that is interrupted", "a run with a brief of another run"),
    *("a run with a wrong clock", "a run where another program listens"),
)
_WITHOUT_RECORDER = "a run without a recorder"
"""Only in cases: it is not drawn."""
_ENDED = frozenset({0, 1, UsageError.exit_status, RunError.exit_status, Interrupted.exit_status, KILLED})
Briefs = dict[str, Brief]
"""Process → its brief."""


def _without_receiver(briefs: Briefs) -> None:
    del briefs[LEGITIMATE]


def _without_recorder(briefs: Briefs) -> None:
    del briefs[RECORDER]


def _wrong_password(briefs: Briefs) -> None:
    briefs[LEGITIMATE]["password"] = "0" * 32


def _other_certificate(briefs: Briefs) -> None:
    briefs[ROUTER]["identity"] = briefs[SENSOR]["identity"]


def _other_name(briefs: Briefs) -> None:
    for brief in briefs.values():
        brief["router"] = brief["router"].replace("127.0.0.1", "localhost")


def _paused(briefs: Briefs) -> None:
    briefs[RECORDER]["part"]["paused"] = True


def _unchanged(briefs: Briefs) -> None:
    del briefs


_RUNS: Mapping[str, tuple[str, Callable[[Briefs], None]]] = {
    "a run": ("tcp", _unchanged),
    _PAUSED: ("tcp", _paused),
    _TAKEN: ("tcp", _unchanged),
    "a run without a receiver": ("tcp", _without_receiver),
    _INTERRUPTED: ("tcp", _unchanged),
    "a run with a wrong password": ("tcp", _wrong_password),
    _RECORDED: ("tcp", _unchanged),
    "a run with certificates": ("tls", _unchanged),
    _STRANGE: ("tls", _unchanged),
    _WRONG_CLOCK: ("tls", _unchanged),
    "a run with the certificate of another process": ("tls", _other_certificate),
    "a run at another name": ("tls", _other_name),
    _WITHOUT_RECORDER: ("tcp", _without_recorder),
}
"""What is run → the protocol of its routers, and what is changed in its briefs."""


@final
class RunByHand(ByHand):
    """The same scenario is run beside the run, all of whose processes somebody starts by hand, in any order."""

    kind, share = "start by hand", 4
    awaited_seconds = 60.0
    """Its processes wait for one that is missing, or that an event has ended: no launcher starts it again."""
    drawn = tuple(name for name in _RUNS if name != _WITHOUT_RECORDER)

    def _act(self, world: SimulatedWorld, scenario: Scenario, folder: Path) -> None:
        if scenario.shards > 1 or scenario.slots > _MOST_SLOTS:
            return
        briefs = self._briefs(world, scenario, folder)
        if self.target == _STRANGE and briefs:
            other = folder / "other"
            other.mkdir(0o700)
            briefs |= {LEGITIMATE: self._briefs(world, scenario, other).get(LEGITIMATE, briefs[LEGITIMATE])}
        if briefs:
            _RUNS[self.target][1](briefs)
        file = folder / "health"
        os.environ[VARIABLE] = str(file)
        try:
            processes = self._run(world, folder, briefs)
        finally:
            os.environ.pop(VARIABLE, None)
        for name, process in processes.items():
            if process.task.status not in _ENDED or "Traceback" in process.printed:
                raise AssertionError(f"{name} ends with status {process.task.status}: {process.printed[-500:]}")
        self._check_refusals(processes)
        done = RECORDER in processes and processes[RECORDER].task.status == 0
        if self.target == _RECORDED:
            self._check_recording(folder / "results" / "recording.rrd", done)
        if done and not file.exists():
            raise AssertionError("no process has touched the health file")

    def _run(self, world: SimulatedWorld, folder: Path, briefs: Briefs) -> Mapping[str, VirtualProcess]:
        """Start a process with each brief, and ask for its health; returns the processes, which have ended."""
        some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        processes = {}
        if self.target == _TAKEN and briefs:
            world.zenoh.occupy(briefs[ROUTER]["router"], some.choice([b"", b"hello"]))
        paths = {name: folder / f"{name}.json" for name in some.sample([*briefs], len(briefs))}
        for name, path in paths.items():
            path.write_text(json.dumps(briefs[name]))
            path.chmod(0o600)
            words = [briefs[name]["role"], str(path)]
            processes[name] = world.machine.begin(f"{name} {BY_HAND}", partial(world.machine.program, words))
        if self.target == _WRONG_CLOCK and processes:
            processes[LEGITIMATE].task.clock = some.choice(_CLOCKS)
        here().sleep(some.uniform(0.0, 1.0))
        if self.target == _INTERRUPTED and processes:
            processes[RECORDER].interrupt()
        elif paths and (status := world.machine.program(["health", str(some.choice([*paths.values()]))])) not in _ENDED:
            raise AssertionError(f"who asks for the health of a process is told status {status}")
        deadline, resumed = here().monotonic() + _RUN_SECONDS, self.target != _PAUSED
        while any(process.task.alive for process in processes.values()) and here().monotonic() < deadline:
            resumed = resumed or world.machine.program(["resume", str(folder / "results")]) == 0
            here().sleep(_POLL_SECONDS)
        waiting = [name for name, process in processes.items() if process.task.alive]
        if self.target == _WITHOUT_RECORDER and waiting:
            raise AssertionError(f"{', '.join(waiting)}: still waiting for a recorder after {_RUN_SECONDS:.0f} s")
        for process in processes.values():
            process.signal(signal.SIGKILL)  # something cut them off from each other
        return processes

    @staticmethod
    def _check_refusals(processes: Mapping[str, VirtualProcess]) -> None:
        """Who cannot read a message tells the recorder, which does not take it for cut off."""
        printed = processes[RECORDER].printed if RECORDER in processes else ""
        for name, process in processes.items():
            if "malformed message" in process.printed and f"{name} cut off" in printed:
                raise AssertionError(f"{name} has refused a message, and the recorder says: {printed[-500:]}")

    @staticmethod
    def _check_recording(path: Path, done: bool) -> None:
        """A run that has ended well is recorded; Rerun's own threads, which are real ones, end."""
        from rerun_bindings import flush_and_cleanup_orphaned_recordings  # noqa: PLC0415 - slow to import

        gc.collect()
        flush_and_cleanup_orphaned_recordings()
        if done and not path.read_bytes().startswith(_RECORDING):
            raise AssertionError(f"{path.name} is no recording")

    def _briefs(self, world: SimulatedWorld, scenario: Scenario, folder: Path) -> Briefs:
        """Write the briefs, and read them; none if the disk does not take them."""
        write_resolved(folder, scenario)
        written, at = folder / "written", f"{_RUNS[self.target][0]}/127.0.0.1"
        places = ["--listen", f"{at}:17470", *(["--relay", f"{at}:17471"] if scenario.relayed else [])]
        words = ["brief", str(folder / "scenario.toml"), *places, "--results", str(folder / "results"), "--wait", "5"]
        if world.machine.program([*words, "--out", str(written)]) != 0:
            return {}
        briefs = {path.stem: json.loads(path.read_text()) for path in sorted(written.glob("*.json"))}
        briefs[RECORDER]["part"]["recording"] = self.target == _RECORDED
        return briefs


_HERE = "tls/127.0.0.1:17480"
_PLACES: Sequence[tuple[str, str | None]] = (
    ("tls/0.0.0.0:17480", None),  # others reach it
    ("nowhere", None),
    (_HERE, _HERE),
    (_HERE, "tcp/127.0.0.1:17481"),
)
"""Where a router and a relay are to listen that cannot."""
_BY_OPTIONS, _BY_HOSTS = "wrong options", "wrong hosts"


@final
class RunWrongly(ByHand):
    """The same scenario is to be run beside the run, with options that no run may have, or files of hosts with mistakes."""

    kind, share = "run beside it with", 2
    drawn = (_BY_OPTIONS, _BY_HOSTS)

    def _act(self, world: SimulatedWorld, scenario: Scenario, folder: Path) -> None:
        process, before = world.machine.current, 0
        some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        for run, said in (
            tried for drawn in _with_others(scenario, some) for tried in self._runs(drawn, folder / "results")
        ):
            status, printed = status_of(run), process.printed[before:]
            before += len(printed)
            refused = status == UsageError.exit_status and said in printed
            if not refused and not _is_lacking(printed):
                raise AssertionError(
                    f"to run with {self.target} ends with status {status}, without {said!r}: {printed}"
                )

    def _runs(self, scenario: Scenario, folder: Path) -> Iterator[tuple[Callable[[], int], str]]:
        """What is tried, each with a text that is printed; folder: for results."""

        def run(listen: str | None = None, relay: str | None = None, *, paused: bool = False) -> int:
            return launch(scenario, folder, "off", listen, lambda _: None, relay, paused=paused).status

        if self.target == _BY_OPTIONS:
            yield from ((partial(run, *places), "") for places in _PLACES)
            if scenario.shards > 1:
                yield partial(run, paused=True), "--paused"
            return
        file = folder.with_name("hosts.toml")

        def load(hosts: DrawnHosts) -> int:
            file.write_text(hosts.text(scenario))
            load_hosts(file, scenario)
            return 0

        for mistake in MISTAKES:
            hosts = DrawnHosts((DrawnHost("alpha", processes_of(scenario)),), mistake)
            if hosts.refused(scenario) == MISTAKES[mistake].message:
                yield partial(load, hosts), MISTAKES[mistake].message
