"""The faults of the simulated world: each says what it does, and what a run promises when it happens.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import os
import shutil
import signal
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, final

from evedrop.errors import Interrupted, UsageError
from evedrop.names import RECORDER, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual.disk import DiskFault
from evedrop.virtual.disturbance import EVERYBODY, KILLED, ROUTERS, Disturbance, processes_of
from evedrop.virtual.host_parts import host_of, part_of
from evedrop.virtual.processes import FORK_SERVERS, LAUNCHER, VirtualProcess

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld
    from evedrop.virtual.zenoh import VirtualZenoh

DISK = "disk"
_SILENCE_SECONDS = 120.0
"""For which a launcher waits for a fork server that is suspended; it waits less for any other process."""
_TELLS_SECONDS = 4.0
"""Within which a fork server is sure to tell its launcher in time that a process has ended."""
_FLAP_SECONDS = 0.05
"""Between two cuts of a connection that flaps."""


class _OfProcess(Disturbance):
    """Something happens to a process."""

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All processes, and rather those which all others need."""
        return [LAUNCHER, *FORK_SERVERS, *processes_of(scenario), ROUTER, SENSOR, RECORDER]

    def strike(self, world: SimulatedWorld) -> bool:
        """Do it, if the process runs."""
        process = world.process(self.target)
        return process is not None and self.disturb(world, process)

    @abstractmethod
    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Do it to a process; returns whether it hit anything."""


class _EndProcess(_OfProcess):
    """Its target ends."""

    number: ClassVar[signal.Signals]
    """The signal that it gets."""

    def survived(self, longest_outage: float) -> bool:
        """Whether it is a router, which the launcher starts again."""
        del longest_outage
        return self.target in ROUTERS

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Send it the signal."""
        del world
        process.signal(self.number)
        return True


class _Kill(_EndProcess):
    """Its target is killed."""

    @property
    def statuses(self) -> frozenset[int]:
        """Those of any failure, and that of a launcher which is killed."""
        return super().statuses | ({KILLED} if self.target == LAUNCHER else frozenset())

    def ends_at_once(self, process: str) -> bool:
        """The target, and the recorder of a launcher."""
        killed = {self.target, *([RECORDER] if self.target == LAUNCHER else [])}
        return process in killed or super().ends_at_once(process)


@final
class KillProcess(_Kill):
    """SIGKILL. A router is started again."""

    kind, share, number = "kill", 14, signal.SIGKILL


@final
class StopAndKillProcess(_Kill):
    """SIGSTOP, and SIGKILL after some time."""

    kind, share = "stop and kill", 4
    lasts, for_good = True, False

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Suspend it, and kill it later."""
        return _suspend(world, process, self.seconds, signal.SIGKILL)

    def survived(self, longest_outage: float) -> bool:
        """Whether it is a router, and not suspended for too long."""
        return super().survived(longest_outage) and Disturbance.survived(self, longest_outage)


class _Signal(_EndProcess):
    """A signal that ends a run if its launcher gets it, or its recorder."""

    @property
    def statuses(self) -> frozenset[int]:
        """Those of any failure, and that of an interrupt, if the run itself is told to end."""
        told = self.target in (LAUNCHER, RECORDER)
        return super().statuses | ({Interrupted.exit_status} if told else frozenset())


@final
class InterruptProcess(_Signal):
    """SIGINT, as by Ctrl-C."""

    kind, share, number = "interrupt", 6, signal.SIGINT

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """The launcher as often as all others together: it is typed at."""
        processes = super().targets(scenario)
        return [*processes, *[LAUNCHER] * len(processes)]


@final
class TerminateProcess(_Signal):
    """SIGTERM."""

    kind, share, number = "terminate", 4, signal.SIGTERM


@final
class HangUpProcess(_Signal):
    """SIGHUP, as when a terminal is closed."""

    kind, share, number = "hang up", 2, signal.SIGHUP


@final
class StopProcess(_OfProcess):
    """SIGSTOP, and SIGCONT after some time."""

    kind, share = "stop", 14
    lasts, cuts_off, loses = True, True, False

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Suspend it."""
        return _suspend(world, process, self.seconds, signal.SIGCONT)

    def survived(self, longest_outage: float) -> bool:
        """A fork server has some seconds to tell of the end of a process; for a recorder, the time stands still."""
        if self.target == RECORDER:
            return self.seconds is not None
        tells = part_of(self.target) not in FORK_SERVERS or (self.seconds is not None and self.seconds < _TELLS_SECONDS)
        return tells and super().survived(longest_outage)

    @property
    def named_first(self) -> bool:
        """Not if it is the program on a host: who waits in vain for a process there cannot know."""
        return super().named_first and not host_of(self.target)

    @property
    def awaited_seconds(self) -> float:
        """That of a fork server, if it is for good."""
        return _SILENCE_SECONDS if self.seconds is None else 0.0


@final
class HangProcess(_OfProcess):
    """The thread that does a process's work does not go on for some time, as on a disk that does not answer; others do."""

    kind, share = "hang", 12
    lasts, cuts_off, loses = True, True, False

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All processes but the recorder, which the launcher lets write for as long as it takes."""
        return [name for name in processes_of(scenario) if name != RECORDER]

    @property
    def blamed(self) -> tuple[str, ...]:
        """It alone: a router that hangs still passes on the answers of all others."""
        return (self.target,)

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Hold it up."""
        world.scheduler.hang(process.task.threads[0], self.seconds)
        return True


@final
class DelayThread(_OfProcess):
    """One of the other threads of a process does not go on for some time, as on a machine that is busy."""

    kind, share = "delay a thread of", 12
    lasts, for_good, harmless, loses = True, False, True, False
    most_seconds = 1.0

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Hold one up that the seed chooses."""
        others = [thread for thread in process.task.threads[1:] if not thread.over]
        if others:
            world.scheduler.hang(world.scheduler.random.choice(others), self.seconds)
        return bool(others)


class _OfConnection(Disturbance):
    """Something happens to the connections of a process, or of everybody."""

    lasts, cuts_off = True, True

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All that connect with a router."""
        return [*(name for name in processes_of(scenario) if name not in ROUTERS), EVERYBODY]

    def strike(self, world: SimulatedWorld) -> bool:
        """Do it to each."""
        targets = world.zenoh.clients if self.target == EVERYBODY else [self.target]
        hit = [self.disturb(world.zenoh, target) for target in targets]
        return any(hit)

    @abstractmethod
    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Do it to the connections of one process; returns whether there are any."""


@final
class CutConnection(_OfConnection):
    """The connection of a process is cut, and cannot be made again for some time."""

    kind, share = "cut", 10

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Cut it."""
        return zenoh.cut(target, self.seconds)


@final
class FlapConnection(_OfConnection):
    """The connection of a process is cut again and again for some time."""

    kind, share = "flap", 4
    for_good = False

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Cut it, also later."""
        scheduler = zenoh.scheduler
        for number in range(1, int((self.seconds or 0.0) / _FLAP_SECONDS) + 1):
            scheduler.after_seconds(number * _FLAP_SECONDS, lambda: zenoh.cut(target, 0.0))
        return zenoh.cut(target, 0.0)


@final
class FreezeConnection(_OfConnection):
    """Nothing gets through the connection of a process for some time, though it seems open."""

    kind, share = "freeze", 10

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Let nothing through."""
        return zenoh.freeze(target, self.seconds)


@final
class ClogRouter(Disturbance):
    """A router passes nothing on, though all its connections seem alive. Only in cases: it is not drawn."""

    kind, share, only_target = "clog", 0, ROUTER

    def strike(self, world: SimulatedWorld) -> bool:
        """Clog it."""
        return world.zenoh.clog(self.target)

    @property
    def blamed(self) -> tuple[str, ...]:
        """It alone: nobody else can answer."""
        return (f"{self.target}: alive, and silent",)


@final
class SlowConnection(_OfConnection):
    """Everything takes longer on the connection of a process."""

    kind, share = "slow", 9
    harmless = True

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Make it slow."""
        return zenoh.slow(target, self.seconds)


@final
class ConfuseKeys(_OfConnection):
    """The next message to a process arrives at the subscriber of another key of it."""

    kind, share = "confuse", 9
    lasts, harmless = False, True  # the message names its key

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Confuse its keys once."""
        return zenoh.confuse(target)


@final
class ShortenMessage(_OfConnection):
    """Half of the next message to a process arrives, as from a program that is not the right one."""

    kind, share = "shorten a message to", 6
    lasts = cuts_off = False

    def disturb(self, zenoh: VirtualZenoh, target: str) -> bool:
        """Let half of one arrive."""
        return zenoh.change(target, lambda message: message[: len(message) // 2])

    @property
    def blamed(self) -> tuple[str, ...]:
        """The sender, which depends on the message."""
        return ("broke the protocol",)


class _OfFiles(Disturbance):
    """Something happens to files that the run writes."""

    lacking, harmless = True, False

    @property
    def statuses(self) -> frozenset[int]:
        """Those of any failure, and that of a file which cannot be used."""
        return super().statuses | {UsageError.exit_status}


class DiskDisturbance(_OfFiles):
    """Something goes wrong with the disk, at the next operation of any process."""

    only_target = DISK
    fault: ClassVar[DiskFault]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it go wrong."""
        world.disk.fail_next(self.fault, self.seconds)
        return True

    @property
    def blamed(self) -> tuple[str, ...]:
        """What was not written."""
        return ("cannot be written", "cannot be started", "cannot be merged", "temporary folder", "disk")


@final
class FillDisk(DiskDisturbance):
    """The disk is full, for some time or for good."""

    kind, share = "fill", 3
    lasts = True
    fault = DiskFault.FULL


@final
class RefuseWrite(DiskDisturbance):
    """One write is refused, as if the disk were full."""

    kind, share = "refuse a write to", 2
    fault = DiskFault.FULL_ONCE


@final
class BreakWrite(DiskDisturbance):
    """An input/output error."""

    kind, share = "break a write to", 2
    fault = DiskFault.BROKEN


@final
class ShortenWrite(DiskDisturbance):
    """Half of a write arrives, and the program is told so."""

    kind, share = "shorten a write to", 2
    fault, harmless, lacking = DiskFault.SHORT, True, False  # the program writes the rest


@final
class CutPower(DiskDisturbance):
    """Everything ends, and the disk keeps what it has."""

    kind, share = "cut the power of", 8

    @property
    def statuses(self) -> frozenset[int]:
        """Those of the disk, and that of a launcher which is killed."""
        return super().statuses | {KILLED}

    def ends_at_once(self, process: str) -> bool:
        """Every process."""
        del process
        return True

    def strike(self, world: SimulatedWorld) -> bool:
        """Cut it."""
        world.disk.power_cut()
        return True


class _OfResults(_OfFiles):
    """Somebody else does something to the results folder of a run that goes on."""

    only_target = "results"

    @property
    def blamed(self) -> tuple[str, ...]:
        """What was not written, or is not there."""
        return ("was removed while the run went on", "cannot be written", "cannot be started", "cannot be merged")


@final
class RenameResults(_OfResults):
    """Moves it."""

    kind, share = "rename", 1

    def strike(self, world: SimulatedWorld) -> bool:
        """Move it beside its place."""
        if not world.results.is_dir():
            return False
        os.rename(world.results, world.renamed)
        return True


@final
class RemoveResults(_OfResults):
    """Removes it, with all that is in it."""

    kind, share = "remove", 1
    destroys = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Remove it."""
        there = world.results.is_dir()
        shutil.rmtree(world.results, ignore_errors=True)
        return there


def _suspend(world: SimulatedWorld, process: VirtualProcess, seconds: float | None, number: signal.Signals) -> bool:
    """Suspend a process, and send it a signal after some time."""
    process.signal(signal.SIGSTOP)
    world.scheduler.after_seconds(seconds, lambda: process.signal(number))
    return True


class _Lack(Disturbance):
    """There is too little of something: a process that needs it ends, and says what it lacks."""

    lacking, harmless = True, False

    @property
    def blamed(self) -> tuple[str, ...]:
        """What is lacking, or who could not be started for that reason."""
        return (
            "not enough memory",
            "no further process or thread can be started",
            "cannot be started",
            "resource",
        )


@final
class LackThreads(_Lack):
    """No thread and no process can be started for some time, or any more."""

    kind, share = "take the threads of", 3
    lasts, only_target = True, "machine"

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it have none."""
        world.machine.no_threads_until = world.scheduler.later(self.seconds)
        return True


@final
class LackMemory(_Lack, _OfProcess):
    """A process does not get the memory that it asks for next."""

    kind, share = "take the memory of", 4

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All processes."""
        return [LAUNCHER, *processes_of(scenario)]

    def disturb(self, world: SimulatedWorld, process: VirtualProcess) -> bool:
        """Let its next large allocation fail."""
        del world
        process.task.lacks_memory = True
        return True
