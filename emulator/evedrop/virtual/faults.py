"""The faults of the simulated world: each says what it does, and what a run promises when it happens.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
import signal
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, final

from evedrop.model.schemes import SCHEMES
from evedrop.names import CONTROLLER, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual.disk import DiskFault
from evedrop.virtual.processes import FORK_SERVERS

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

LAUNCHER = "launcher"
_ROUTERS = (ROUTER, RELAY)
_MOST_FAULTS = 3
_LATE = 0.5
"""The fraction of faults that strike at any moment of a run; the others strike rather at its beginning."""
_FIRST = 20
"""Events, of the starts of the first processes, before which no fault strikes."""
_OF_PROCESS, _OF_SLOT = 8, 1.2
"""About how many events there are for each process of a run, and for each slot of a receiver for which somebody waits."""


@dataclass(frozen=True)
class Disturbance(ABC):
    """Something that happens to a run."""

    target: str
    """The process that it hits."""
    after: int
    """The number of events in the world after which it strikes."""
    seconds: float | None = None
    """How long it lasts; None for good, or where it does not last."""

    kind: ClassVar[str]
    lasts: ClassVar[bool] = False
    """Whether it has a duration."""

    @abstractmethod
    def strike(self, world: SimulatedWorld) -> bool:
        """Do it; returns whether it hit anything."""

    def survived(self, longest_outage: float) -> bool:
        """Whether the run must go on to its end as if nothing had happened."""
        return self.seconds is not None and self.seconds < longest_outage / 2.0

    @property
    def blamed(self) -> tuple[str, ...]:
        """What a failure that it causes may name: who is cut off cannot tell who is at fault."""
        if self.target in FORK_SERVERS:
            return ("fork server",)
        return (self.target, *(_ROUTERS if self.target in (RECORDER, *_ROUTERS) else ()))

    def __str__(self) -> str:
        lasting = "" if not self.lasts else " for good" if self.seconds is None else f" for {self.seconds:.2f} s"
        return f"{self.kind} {self.target}{lasting} after {self.after} events"


@final
class KillProcess(Disturbance):
    """SIGKILL. A router is started again."""

    kind = "kill"

    def strike(self, world: SimulatedWorld) -> bool:
        """Kill it."""
        return _signal(world, self.target, signal.SIGKILL)

    def survived(self, longest_outage: float) -> bool:
        """Whether it is a router, which the launcher starts again."""
        del longest_outage
        return self.target in _ROUTERS


@final
class InterruptProcess(Disturbance):
    """SIGTERM, which ends a run if its launcher gets it."""

    kind = "interrupt"

    def strike(self, world: SimulatedWorld) -> bool:
        """Ask it to end."""
        return _signal(world, self.target, signal.SIGTERM)

    def survived(self, longest_outage: float) -> bool:
        """Whether it is a router, which the launcher starts again."""
        del longest_outage
        return self.target in _ROUTERS


@final
class StopProcess(Disturbance):
    """SIGSTOP, and SIGCONT after some time."""

    kind = "stop"
    lasts = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Suspend it."""
        process = world.process(self.target)
        if process is None:
            return False
        process.signal(signal.SIGSTOP)
        if self.seconds is not None:
            world.scheduler.at(world.scheduler.now + self.seconds, lambda: process.signal(signal.SIGCONT))
        return True


@final
class CutConnection(Disturbance):
    """The connection of a process is cut, and cannot be made again for some time."""

    kind = "cut"
    lasts = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Cut it."""
        return world.zenoh.cut(self.target, self.seconds)


@final
class FreezeConnection(Disturbance):
    """Nothing gets through the connection of a process for some time, though it seems open."""

    kind = "freeze"
    lasts = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Let nothing through."""
        return world.zenoh.freeze(self.target, self.seconds)


@final
class SlowConnection(Disturbance):
    """Everything takes longer on the connection of a process."""

    kind = "slow"
    lasts = True

    def strike(self, world: SimulatedWorld) -> bool:
        """Make it slow."""
        return world.zenoh.slow(self.target, self.seconds)

    def survived(self, longest_outage: float) -> bool:
        """It always is."""
        del longest_outage
        return True


@final
class ConfuseKeys(Disturbance):
    """The next message to a process arrives at the subscriber of another key of it."""

    kind = "confuse"

    def strike(self, world: SimulatedWorld) -> bool:
        """Confuse its keys once."""
        return world.zenoh.confuse(self.target)

    def survived(self, longest_outage: float) -> bool:
        """It always is: the message names its key."""
        del longest_outage
        return True


class DiskDisturbance(Disturbance):
    """Something goes wrong with the disk, at the next operation of any process."""

    fault: ClassVar[DiskFault]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let it go wrong."""
        disk = world.disk
        at = disk.operations + 1
        disk.faults = lambda operation: self.fault if operation == at else None
        if self.seconds is not None:
            world.scheduler.at(world.scheduler.now + self.seconds, disk.make_room)
        return True

    def survived(self, longest_outage: float) -> bool:
        """It may end a run."""
        del longest_outage
        return False

    @property
    def blamed(self) -> tuple[str, ...]:
        """What was not written."""
        return ("cannot be written", "cannot be started", "cannot be merged", "temporary folder", "disk")


@final
class FillDisk(DiskDisturbance):
    """The disk is full, for some time or for good."""

    kind = "fill"
    lasts = True
    fault = DiskFault.FULL


@final
class RefuseWrite(DiskDisturbance):
    """One write is refused, as if the disk were full."""

    kind = "refuse a write to"
    fault = DiskFault.FULL_ONCE


@final
class BreakWrite(DiskDisturbance):
    """An input/output error."""

    kind = "break a write to"
    fault = DiskFault.BROKEN


@final
class ShortenWrite(DiskDisturbance):
    """Half of a write arrives, and the program is told so."""

    kind = "shorten a write to"
    fault = DiskFault.SHORT

    def survived(self, longest_outage: float) -> bool:
        """The program writes the rest."""
        del longest_outage
        return True


@final
class CutPower(DiskDisturbance):
    """Everything ends, and the disk keeps what it has."""

    kind = "cut the power of"

    def strike(self, world: SimulatedWorld) -> bool:
        """Cut it."""
        world.disk.power_cut()
        return True


DISK = "disk"
KINDS: Mapping[str, type[Disturbance]] = {
    disturbance.kind: disturbance
    for disturbance in (
        KillProcess,
        InterruptProcess,
        StopProcess,
        CutConnection,
        FreezeConnection,
        SlowConnection,
        ConfuseKeys,
        FillDisk,
        RefuseWrite,
        BreakWrite,
        ShortenWrite,
        CutPower,
    )
}
_OF_PROCESSES: tuple[type[Disturbance], ...] = (KillProcess, InterruptProcess, StopProcess)
_OF_CONNECTIONS: tuple[type[Disturbance], ...] = (CutConnection, FreezeConnection, SlowConnection, ConfuseKeys)
_OF_DISK: tuple[type[Disturbance], ...] = tuple(kind for kind in KINDS.values() if issubclass(kind, DiskDisturbance))
_OFTEN: Mapping[tuple[type[Disturbance], ...], float] = {_OF_PROCESSES: 0.45, _OF_CONNECTIONS: 0.4, _OF_DISK: 0.15}
"""Kinds of faults → how often one is of these: a process or a connection can be hit at any message, and a disk at few moments."""


def _signal(world: SimulatedWorld, target: str, number: signal.Signals) -> bool:
    process = world.process(target)
    if process is None:
        return False
    process.signal(number)
    return True


def processes_of(scenario: Scenario) -> tuple[str, ...]:
    """The processes that the launcher of a scenario starts."""
    relay = (RELAY,) if scenario.relayed else ()
    controller = (CONTROLLER,) if scenario.controller is not None else ()
    return (ROUTER, *relay, SENSOR, *scenario.receivers, *controller, RECORDER)


def events_of(scenario: Scenario, ahead: int) -> float:
    """About how many events a run has; ahead: how many slots the sensor may be ahead.

    A message carries some slots, unless each slot waits for an answer or for its time.
    """
    answered = scenario.controller is not None or SCHEMES[scenario.encoding.spec["scheme"]].needs_acknowledgements
    messages = scenario.slots if answered or scenario.pace else scenario.slots * 4.0 / ahead
    processes = len(processes_of(scenario))
    return scenario.shards * processes * (_OF_PROCESS + messages * (2.0 if answered else _OF_SLOT))


def faults_of(source: random.Random, scenario: Scenario, ahead: int) -> tuple[Disturbance, ...]:
    """The faults of a case; ahead: as in `events_of`."""
    processes = processes_of(scenario)
    last = max(2.0 * _FIRST, events_of(scenario, ahead))
    faults = []
    for _ in range(source.choice([0, 1, 1, 1, 2, _MOST_FAULTS])):
        [kinds] = source.choices([*_OFTEN], [*_OFTEN.values()])
        kind = source.choice(kinds)
        targets = {
            _OF_PROCESSES: [LAUNCHER, *FORK_SERVERS, *processes, ROUTER, SENSOR, RECORDER],  # which all others need
            _OF_CONNECTIONS: [name for name in processes if name not in _ROUTERS],
            _OF_DISK: [DISK],
        }
        target = source.choice(targets[kinds])
        seconds = None
        if kind.lasts and source.random() < 0.85:
            seconds = round(10.0 ** source.uniform(-2.0, 1.0), 3)
        uniform = source.random() < _LATE
        after = int(source.uniform(_FIRST, last) if uniform else _FIRST * (last / _FIRST) ** source.random())
        faults.append(kind(target, after, seconds))
    return tuple(faults)
