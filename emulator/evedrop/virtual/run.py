"""A live run in the simulated world: its launcher, and all the processes that it starts.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO, cast, final

from evedrop.live.launch.briefs import MOST_SLOTS_AHEAD
from evedrop.live.launch.hosts_file import load_hosts
from evedrop.live.launch.launcher import launch
from evedrop.live.launch.other_hosts import SILENCE_SECONDS
from evedrop.names import RELAY, ROUTER
from evedrop.scenario.progress_events import ProgressEvent
from evedrop.scenario.tables import Scenario
from evedrop.system.world import inside
from evedrop.virtual import notes
from evedrop.virtual.disk import VirtualDisk
from evedrop.virtual.endings import status_of
from evedrop.virtual.host_parts import LISTENS, SESSION
from evedrop.virtual.notes import PutMessage
from evedrop.virtual.other_hosts import OtherHosts
from evedrop.virtual.processes import ProcessOutput, Program, VirtualMachine, VirtualProcess
from evedrop.virtual.scheduler import Occurrence, Stuck, VirtualScheduler
from evedrop.virtual.steered import Typed
from evedrop.virtual.world import VirtualWorld
from evedrop.virtual.zenoh import VirtualZenoh

MOST_SECONDS = 900.0
"""Virtual seconds, besides those of its slots, within which every run must end, whatever happens to it."""
_ROUTER, _RELAY = "tcp/127.0.0.1:17460", "tcp/127.0.0.1:17461"
"""Where two routers of a run listen; those of shards take free ports. Encryption is not simulated."""
_LEAVE_SECONDS = 60.0
"""Virtual seconds for processes whose launcher has ended, or was killed, to write what they have and to end."""
_LEAVE_HOSTS_SECONDS = SILENCE_SECONDS + 100.0
"""The same for programs on other hosts, which wait for a launcher that is silent."""
_CLEAN_SECONDS = 1.0
"""In which a host removes the files of a program that was killed."""


@final
@dataclass
class SimulatedRun:
    """What became of a run in the simulated world."""

    folder: Path
    """Of its results."""
    status: int | None = None
    """The exit status of its launcher; None if it never ended."""
    said: str = ""
    """What the launcher wrote to standard error."""
    told: list[tuple[float, ProgressEvent]] = field(default_factory=list)
    """The events that the launcher got, each with its virtual time."""
    ends: dict[str, tuple[float, int]] = field(default_factory=dict)
    """Process → when the latest one of this name ended, and its exit status."""
    left: list[str] = field(default_factory=list)
    """Processes that outlived it."""
    suspended: bool = False
    """Whether its launcher was suspended for good, and all others have ended."""
    stuck: str | None = None
    """Why it did not end, if so."""
    errors: list[tuple[str, BaseException]] = field(default_factory=list)
    """Thread → the exception that nobody caught."""
    ended: float = 0.0
    """When its launcher ended, in virtual seconds."""
    seconds: float = 0.0
    """Virtual seconds until all processes had ended."""
    events: int = 0
    digest: str = ""
    """The hash of all events."""
    put: list[PutMessage] = field(default_factory=list)
    """The messages that all processes have put."""
    typed: list[Typed] = field(default_factory=list)
    """The commands of operators."""
    misled: list[tuple[float, str, str]] = field(default_factory=list)
    """When a message of another key arrived as a command, at which process, and that key."""
    happened: list[Occurrence] = field(default_factory=list)
    """All events, if they were kept."""


@final
class SimulatedWorld:
    """The parts of a simulated world, for those who disturb it."""

    def __init__(self, seed: int, program: Program, root: Path, keep: bool = False) -> None:
        """program: what `evedrop` is there. root: an empty folder for its disk. keep: whether to keep all events."""
        self.scheduler = VirtualScheduler(seed, keep)
        self.machine = VirtualMachine(self.scheduler, program)
        self.zenoh = VirtualZenoh(self.scheduler)
        self.disk = VirtualDisk(self.scheduler, root)
        self.scenario: Scenario | None = None
        """What is run there."""
        self.ahead = MOST_SLOTS_AHEAD
        """How many slots its sensor may be ahead."""
        self.told: list[tuple[float, ProgressEvent]] = []
        """The events that its launcher got."""
        self.typed: list[Typed] = []
        """The commands of operators."""
        self.places: Mapping[str, str] = {}
        """Router → where it listens, if that is at a port."""
        self.hosts: OtherHosts | None = None
        """The other hosts, if there are any."""
        self.results, self.renamed = self.disk.root / "results", self.disk.root / "renamed"
        """Where the results of a run are, and where somebody else may move them."""
        self.world = VirtualWorld(self.scheduler, self.machine, self.zenoh, self.disk)

    @property
    def results_now(self) -> Path:
        """Where the results of a run are: somebody may have moved them."""
        return self.renamed if self.renamed.is_dir() else self.results

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Let all programs of the interpreter be in this world while the block runs."""
        out, err = (cast(TextIO, ProcessOutput(self.machine, stream)) for stream in (sys.stdout, sys.stderr))
        with contextlib.ExitStack() as stack:
            stack.callback(os.umask, os.umask(0o077))
            stack.enter_context(inside(self.world))
            stack.enter_context(contextlib.redirect_stdout(out))
            stack.enter_context(contextlib.redirect_stderr(err))
            stack.callback(self.machine.close)
            stack.callback(self.scheduler.take_down)
            yield

    def add_hosts(self, root: Path, oddities: Mapping[str, str]) -> OtherHosts:
        """Add other hosts; root, oddities: as for `OtherHosts`."""
        self.hosts = OtherHosts(self.machine, self.zenoh, self.world.disks, root, oddities)
        self.world.client = self.hosts.ssh
        return self.hosts

    def process(self, name: str) -> VirtualProcess | None:
        """The latest process of this name, if it runs."""
        running = [process for process in self.machine.processes if process.task.name == name and process.task.alive]
        return running[-1] if running else None


def run_in(
    world: SimulatedWorld,
    scenario: Scenario,
    ahead: int = MOST_SLOTS_AHEAD,
    hosts_file: Path | None = None,
    begin: Callable[[], object] = lambda: None,
) -> SimulatedRun:
    """Run a scenario live in a simulated world; ahead: as for `launch`.

    hosts_file: that of `--hosts`, if the world has other hosts. begin: begins other programs, before the launcher.
    """
    run = SimulatedRun(world.results)
    world.scenario, world.ahead, world.told, world.typed = scenario, ahead, run.told, run.typed
    given = {ROUTER: _ROUTER, RELAY: _RELAY} if scenario.relayed and scenario.shards == 1 else {}
    world.places = given if hosts_file is None else LISTENS
    scheduler = world.scheduler

    def watch(name: str, what: str, words: tuple[object, ...]) -> None:
        if what == notes.PUT and not name.endswith(notes.BY_HAND):
            run.put.append(PutMessage(scheduler.now, str(words[0]), str(words[2])))
        elif what == notes.ENDS:
            process, status = words
            run.ends[str(process)] = scheduler.now, int(str(status))
        elif what == notes.LOST:
            process, key, _, why = words
            if key != f"control/{process}" and why == notes.came_as(f"control/{process}"):
                run.misled.append((scheduler.now, str(process), str(key)))

    scheduler.watchers.append(watch)

    def launcher() -> int:
        return launch(
            scenario,
            world.results,
            "off",
            given.get(ROUTER),
            lambda event: run.told.append((scheduler.now, event)),
            given.get(RELAY),
            hosts=None if hosts_file is None else load_hosts(hosts_file, scenario),
            ahead=ahead,
        ).status

    with world.entered():
        begin()
        process = world.machine.begin("launcher", lambda: status_of(launcher))
        try:
            scheduler.run(MOST_SECONDS + scenario.slots * scenario.pace, lambda: not process.task.alive)
            ended = scheduler.now
            leave = _LEAVE_SECONDS if world.hosts is None else _LEAVE_HOSTS_SECONDS
            with contextlib.suppress(Stuck):
                scheduler.run(ended + leave, lambda: not _alive(world))
            if world.hosts is not None:
                with contextlib.suppress(Stuck):
                    scheduler.run(scheduler.now + _CLEAN_SECONDS, lambda: False)
                with contextlib.suppress(Stuck):  # what somebody has started meanwhile
                    scheduler.run(ended + leave, lambda: not _alive(world))
        except Stuck as why:
            ended = scheduler.now
            run.suspended = process.task.stopped  # the processes of a run that has failed wait for it to end them
            run.stuck = None if run.suspended else str(why)
        run.status, run.said, run.left = process.task.status, process.printed, [] if run.suspended else _alive(world)
        run.ended = ended
        run.errors, run.seconds, run.events = scheduler.errors, scheduler.now, scheduler.events
        run.digest, run.happened = scheduler.digest, scheduler.happened
        run.folder = world.results_now
    return run


def _alive(world: SimulatedWorld) -> list[str]:
    """All processes that run, but those of other programs."""
    names = [process.task.name for process in world.machine.processes if process.task.alive]
    return [name for name in names if not name.startswith(SESSION)]
