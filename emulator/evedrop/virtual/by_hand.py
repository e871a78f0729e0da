"""Somebody who writes briefs beside a run, also with wrong options, breaks one of them, and starts its process by hand.

Source: docs/hosts.md, processes started by hand.
"""

from __future__ import annotations

import gc
import json
import random
import signal
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.names import LEGITIMATE, RECORDER, ROUTER
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.disturbance import KILLED, Disturbance
from evedrop.virtual.notes import BY_HAND

if TYPE_CHECKING:
    from evedrop.virtual.processes import VirtualProcess
    from evedrop.virtual.run import SimulatedWorld

_PORT = 20_000
_AT, _RELAY_AT = "tls/127.0.0.1:{port}", "tls/127.0.0.1:{relay_port}"
_OPTIONS: Mapping[str, Sequence[str]] = {
    "briefs": ("--listen", _AT),
    "unencrypted briefs": ("--listen", "tcp/127.0.0.1:{port}"),
    "briefs for a host": ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}", "--insecure"),
    "files for containers": (),
}
"""What is written → the options for it, in a run with one router; with two, those of the relay are added."""
_WRONG_OPTIONS: Mapping[str, Sequence[str]] = {
    "briefs without encryption": ("--listen", "tcp/0.0.0.0:{port}", "--connect", "tcp/router.lan:{port}"),
    "briefs for everywhere": ("--listen", "tls/0.0.0.0:{port}"),
    "briefs for two protocols": ("--listen", _AT, "--connect", "tcp/router.lan:{port}"),
    "briefs for a sixth version": ("--listen", "tls/[fd00::1]:{port}"),
    "briefs for no endpoint": ("--listen", "nowhere"),
    "briefs for a needless relay": ("--listen", _AT, "--relay-connect", _RELAY_AT),
    "briefs for two at one place": ("--listen", _AT, "--relay", _AT),
    "briefs for a mixture": ("--listen", _AT, "--relay", "tcp/127.0.0.1:{relay_port}"),
}
"""The same, for what is refused in any case."""
_CONTAINERS = "files for containers"
_WAIT_SECONDS, _POLL_SECONDS = "1", 0.2
_MOST_SLOTS = 20
_LACKS = ("No space left on device", "Input/output error", "not enough memory")
_PATIENCE_SECONDS, _RUN_SECONDS = 10.0, 40.0
_STARTED = 4
"""How many processes are started, one after the other."""
_STOPS = 0.4
"""How often a table itself is wrong, and not an entry of it."""
_CLOCKS = (-90.0 * 86_400.0, 90.0 * 86_400.0)
"""By how many seconds a clock is wrong, so that no certificate is valid."""
_RECORDED, _RECORDING = "a run that is recorded for views", b"RRF2"
"""How Rerun's files begin."""
_SECURE, _STRANGE = "a run with certificates", "a run with a brief of another run"
_ENDED = frozenset({0, 1, UsageError.exit_status, RunError.exit_status, Interrupted.exit_status, KILLED})
_WRONG: Sequence[Any] = (None, True, -1, 2**70, float("inf"), "", "x", "/nowhere", [], {}, [[1.0]], {"scheme": "x"})
"""What an entry of a brief is replaced with."""


class _ByHand(Disturbance):
    """Somebody does something beside the run, in a folder of its own."""

    harmless = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Let somebody do it, who gives up if the disk does not take it."""

        def act() -> int:
            with suppress(OSError):
                return self._act(world)
            return 1

        world.machine.begin("somebody", act)
        return True

    @abstractmethod
    def _act(self, world: SimulatedWorld) -> int:
        """Do it; returns the exit status. Raises OSError."""


@final
class WriteBriefs(_ByHand):
    """`evedrop brief`, and a process that is started with one of the briefs, in which an entry may be wrong."""

    kind, share = "write", 3
    awaited_seconds = 60.0

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """What is written: mostly what somebody could use."""
        del scenario
        return [*[*_OPTIONS] * 3, *_WRONG_OPTIONS]

    def _act(self, world: SimulatedWorld) -> int:
        scenario, folder = world.scenario, world.disk.root / f"by hand {self.after}"
        if scenario is None or folder.exists():
            return 0
        folder.mkdir(0o700)
        written = folder / "written"
        status = world.machine.program([*self._words(scenario, folder), str(written)])
        expected = UsageError.exit_status if self._refused(scenario) else 0
        if status != expected and not any(lack in world.machine.current.printed for lack in _LACKS):
            raise AssertionError(f"to write {self.target} ends with status {status}")
        if status == 0 and self.target == _CONTAINERS:
            text = (written / "docker-compose.yml").read_text()
            lacking = [name for name in (ROUTER, *scenario.receivers) if f"{name}:" not in text]
            if lacking:
                raise AssertionError(f"no container is for {', '.join(lacking)}")
        elif status == 0:
            some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
            for _ in range(_STARTED):
                self._start(world, some, sorted(written.glob("*.json")))
        return 0

    def _words(self, scenario: Scenario, folder: Path) -> list[str]:
        from evedrop.results.resolved_scenario import write_resolved  # noqa: PLC0415

        write_resolved(folder, scenario)
        words = ["brief", str(folder / "scenario.toml")]
        if self.target == _CONTAINERS:
            return [*words, "--compose"]
        options = _OPTIONS.get(self.target) or _WRONG_OPTIONS[self.target]
        if scenario.relayed and self.target in _OPTIONS:
            options = [*options, "--relay", options[1].replace("{port}", "{relay_port}")]
            if "--connect" in options:
                options += ["--relay-connect", options[3].replace("{port}", "{relay_port}")]
        port = _PORT + 2 * self.after % _PORT
        words += [option.format(port=port, relay_port=port + 1) for option in options]
        return [*words, "--wait", _WAIT_SECONDS, "--results", str(folder / "results"), "--out"]

    def _refused(self, scenario: Scenario) -> bool:
        if self.target == _CONTAINERS:
            return scenario.shards > 1 or scenario.modules is not None or scenario.process.source == "zenoh"
        return self.target in _WRONG_OPTIONS or scenario.shards > 1

    @staticmethod
    def _start(world: SimulatedWorld, some: random.Random, briefs: Sequence[Path]) -> None:
        """Start a process with a brief in which an entry is wrong, or where a clock is; it ends, and says why."""
        path, other = (some.choice(briefs) for _ in range(2))
        text = path.read_text()
        brief = json.loads(text)
        clock = 0.0
        if some.random() < 0.2:
            clock = some.choice(_CLOCKS)
        elif some.random() < 0.2:
            _exchange(some, brief, json.loads(other.read_text()))
            path.write_text(json.dumps(brief))
        else:
            path.write_text(json.dumps(_broken(some, brief)))
        path.chmod(0o644 if some.random() < 0.1 else 0o600)
        role = json.loads(text)["role"]
        process = world.machine.begin(BY_HAND, lambda: world.machine.program([role, str(path)]))
        process.task.clock = clock
        deadline = here().monotonic() + _PATIENCE_SECONDS
        while process.task.status is None and here().monotonic() < deadline:
            here().sleep(_POLL_SECONDS)
        process.signal(signal.SIGKILL)  # the wrong entry may be how long it waits for others
        path.write_text(text)
        ended = process.task.status in {UsageError.exit_status, RunError.exit_status, KILLED}
        if not ended or "Traceback" in process.printed:
            raise AssertionError(
                f"{role} ends with status {process.task.status} because of a wrong brief: {process.printed[-500:]}"
            )


@final
class RunByHand(_ByHand):
    """The same scenario is run beside the run, all of whose processes somebody starts by hand, in any order."""

    kind, share = "start by hand", 2
    awaited_seconds = 60.0
    """Its processes wait for one that is missing, or that an event has ended: no launcher starts it again."""

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """Whole runs, and those in which a process or a brief is not the right one."""
        del scenario
        return [
            "a run",
            "a run",
            "a run without a receiver",
            "a run that is interrupted",
            "a run with a wrong password",
            _RECORDED,
            _SECURE,
            _STRANGE,
        ]

    def _act(self, world: SimulatedWorld) -> int:
        scenario, folder = world.scenario, world.disk.root / f"by hand {self.after}"
        if scenario is None or folder.exists() or scenario.shards > 1 or scenario.slots > _MOST_SLOTS:
            return 0
        recorded = self.target == _RECORDED
        briefs = self._briefs(world, scenario, folder, recorded=recorded)
        if self.target == _STRANGE:
            others = {path.name: path for path in self._briefs(world, scenario, folder / "other", recorded=False)}
            briefs = [others.get(path.name, path) if path.stem == LEGITIMATE else path for path in briefs]
        some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        some.shuffle(briefs)
        if self.target == "a run without a receiver":
            briefs = [path for path in briefs if path.stem != LEGITIMATE]
        processes = {}
        if self.target == "a run with a wrong password":
            wrong = next(path for path in briefs if path.stem == LEGITIMATE)
            wrong.write_text(json.dumps({**json.loads(wrong.read_text()), "password": "0" * 32}))
        for path in briefs:
            role = json.loads(path.read_text())["role"]
            words = [role, str(path)]
            processes[path.stem] = world.machine.begin(f"{path.stem} {BY_HAND}", partial(world.machine.program, words))
        if self.target == "a run that is interrupted":
            here().sleep(some.uniform(0.0, 1.0))
            processes[RECORDER].interrupt()
        deadline = here().monotonic() + _RUN_SECONDS
        while any(process.task.alive for process in processes.values()) and here().monotonic() < deadline:
            here().sleep(_POLL_SECONDS)
        for process in processes.values():
            process.signal(signal.SIGKILL)  # something cut them off from each other
        for name, process in processes.items():
            if process.task.status not in _ENDED or "Traceback" in process.printed:
                raise AssertionError(f"{name} ends with status {process.task.status}: {process.printed[-500:]}")
        if recorded:
            self._check_recording(folder / "results" / "recording.rrd", processes)
        return 0

    @staticmethod
    def _check_recording(path: Path, processes: Mapping[str, VirtualProcess]) -> None:
        """A run that has ended well is recorded; Rerun's own threads, which are real ones, end."""
        from rerun_bindings import flush_and_cleanup_orphaned_recordings  # noqa: PLC0415 - slow to import

        gc.collect()
        flush_and_cleanup_orphaned_recordings()
        recorder = processes.get(RECORDER)
        if recorder is not None and recorder.task.status == 0 and not path.read_bytes().startswith(_RECORDING):
            raise AssertionError(f"{path.name} is no recording")

    def _briefs(self, world: SimulatedWorld, scenario: Scenario, folder: Path, *, recorded: bool) -> list[Path]:
        """Write the briefs; none if the disk does not take them. recorded: whether the run is recorded for views."""
        from evedrop.results.resolved_scenario import write_resolved  # noqa: PLC0415

        folder.mkdir(0o700)
        write_resolved(folder, scenario)
        written = folder / "written"
        at = f"{'tls' if self.target in {_SECURE, _STRANGE} else 'tcp'}/127.0.0.1"
        places = ["--listen", f"{at}:17470", *(["--relay", f"{at}:17471"] if scenario.relayed else [])]
        words = ["brief", str(folder / "scenario.toml"), *places, "--results", str(folder / "results"), "--wait", "5"]
        status = world.machine.program([*words, "--out", str(written)])
        if status == 0 and not recorded:
            recorder = written / f"{RECORDER}.json"
            brief = json.loads(recorder.read_text())
            brief["part"]["recording"] = False
            recorder.write_text(json.dumps(brief))
        return sorted(written.glob("*.json")) if status == 0 else []


def _exchange(some: random.Random, brief: dict[str, Any], other: Mapping[str, Any]) -> None:
    """Let a brief have the identity of another process, or the key of its identity, or the keys of its random streams."""
    mine, its = brief.get("identity"), other.get("identity")
    if mine is None or its is None or some.random() < 0.3:
        brief["keys"] = other["keys"]
    elif some.random() < 0.5:
        brief["identity"] = its
    else:
        mine["key"] = its["key"]


def _broken(some: random.Random, brief: Any) -> Any:
    """A brief in which an entry is wrong, lacks or is too many."""
    broken: Any = deepcopy(brief)
    *path, last = _place(some, broken)
    table = broken
    for name in path:
        table = table[name]
    chance = some.random()
    if chance < 0.3:
        del table[last]
    elif chance < 0.4 and isinstance(table, dict):
        table["unknown"] = 1
    elif isinstance(table[last], str) and chance < 0.6:
        table[last] = table[last][1:]
    else:
        table[last] = some.choice(_WRONG)
    return broken


def _place(some: random.Random, table: Any) -> list[Any]:
    """The keys that lead to an entry of a brief, which may be a table or a list: a large one is hit no more often."""
    path = list[Any]()
    while isinstance(table, dict | list) and table:
        path.append(some.choice([*table]) if isinstance(table, dict) else some.randrange(len(table)))
        table = table[path[-1]]
        if some.random() < _STOPS:
            break
    return path
