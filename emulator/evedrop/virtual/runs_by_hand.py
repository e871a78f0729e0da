"""Somebody who runs the same scenario beside a run: each process by hand, or all with options that are wrong.

Source: docs/hosts.md, processes started by hand.
"""

from __future__ import annotations

import gc
import json
import os
import random
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, final

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.live.launch.hosts_file import load_hosts, processes_of
from evedrop.live.launch.launcher import launch
from evedrop.live.network.connection import VARIABLE
from evedrop.names import LEGITIMATE, RECORDER, ROUTER, SENSOR
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.by_hand import CLOCKS, LACKS, SCENARIOS, Brief, ByHand, any_scenario
from evedrop.virtual.disturbance import KILLED
from evedrop.virtual.drawn_hosts import MISTAKES, DrawnHost, DrawnHosts
from evedrop.virtual.endings import status_of
from evedrop.virtual.notes import BY_HAND

if TYPE_CHECKING:
    from evedrop.virtual.processes import VirtualProcess
    from evedrop.virtual.run import SimulatedWorld

_MOST_SLOTS = 40
_POLL_SECONDS, _RUN_SECONDS = 0.2, 40.0
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

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """Whole runs, and those in which a process or a brief is not the right one."""
        del scenario
        return [name for name in _RUNS if name != _WITHOUT_RECORDER]

    def _act(self, world: SimulatedWorld) -> int:
        scenario, folder = world.scenario, world.disk.root / f"by hand {self.after}"
        if scenario is None or folder.exists() or scenario.shards > 1 or scenario.slots > _MOST_SLOTS:
            return 0
        briefs = self._briefs(world, scenario, folder)
        if self.target == _STRANGE and briefs:
            briefs |= {LEGITIMATE: self._briefs(world, scenario, folder / "other").get(LEGITIMATE, briefs[LEGITIMATE])}
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
        return 0

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
            processes[LEGITIMATE].task.clock = some.choice(CLOCKS)
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
        said = processes[RECORDER].printed if RECORDER in processes else ""
        for name, process in processes.items():
            if "malformed message" in process.printed and f"{name} cut off" in said:
                raise AssertionError(f"{name} has refused a message, and the recorder says: {said[-500:]}")

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
        folder.mkdir(0o700)
        write_resolved(folder, scenario)
        written, at = folder / "written", f"{_RUNS[self.target][0]}/127.0.0.1"
        places = ["--listen", f"{at}:17470", *(["--relay", f"{at}:17471"] if scenario.relayed else [])]
        words = ["brief", str(folder / "scenario.toml"), *places, "--results", str(folder / "results"), "--wait", "5"]
        if world.machine.program([*words, "--out", str(written)]) != 0:
            return {}
        briefs = {path.stem: json.loads(path.read_text()) for path in sorted(written.glob("*.json"))}
        briefs[RECORDER]["part"]["recording"] = self.target == _RECORDED
        return briefs


_AT = "tls/127.0.0.1:17480"
_OPTIONS: Sequence[tuple[str, str | None]] = (
    ("tls/0.0.0.0:17480", None),  # others reach it
    ("nowhere", None),
    (_AT, _AT),
    (_AT, "tcp/127.0.0.1:17481"),
)
"""Where a router and a relay are to listen that cannot."""
_WRONG_OPTIONS, _WRONG_HOSTS = "wrong options", "wrong hosts"


@final
class RunWrongly(ByHand):
    """The same scenario is to be run beside the run, with options that no run may have, or files of hosts with mistakes."""

    kind, share = "run beside it with", 2

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """Both."""
        del scenario
        return [_WRONG_OPTIONS, _WRONG_HOSTS]

    def _act(self, world: SimulatedWorld) -> int:
        if world.scenario is not None:
            process, before = world.machine.current, 0
            some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
            scenarios = [world.scenario, *(any_scenario(some) for _ in range(1, SCENARIOS))]
            (world.disk.root / f"by hand {self.after}").mkdir(0o700)
            for run, said in (tried for scenario in scenarios for tried in self._runs(world, scenario)):
                status, printed = status_of(run), process.printed[before:]
                before += len(printed)
                if (status != UsageError.exit_status or said not in printed) and not any(
                    lack in printed for lack in LACKS
                ):
                    raise AssertionError(
                        f"to run with {self.target} ends with status {status}, without {said!r}: {printed}"
                    )
        return 0

    def _runs(self, world: SimulatedWorld, scenario: Scenario) -> Iterator[tuple[Callable[[], int], str]]:
        """What is tried, each with a text that is printed."""
        folder = world.disk.root / f"by hand {self.after}" / "results"

        def run(listen: str | None = None, relay: str | None = None, *, paused: bool = False) -> int:
            return launch(scenario, folder, "off", listen, lambda _: None, relay, paused=paused).status

        if self.target == _WRONG_OPTIONS:
            yield from ((partial(run, *places), "") for places in _OPTIONS)
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
