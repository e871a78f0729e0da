"""Faults of a simulated machine that runs out of something: threads and processes, or memory.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

from evedrop.scenario.tables import Scenario
from evedrop.virtual.disturbance import LAUNCHER, Disturbance, processes_of

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld


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
class LackMemory(_Lack):
    """A process does not get the memory that it asks for next."""

    kind, share = "take the memory of", 4

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """All processes."""
        return [LAUNCHER, *processes_of(scenario)]

    def strike(self, world: SimulatedWorld) -> bool:
        """Let its next large allocation fail."""
        process = world.process(self.target)
        if process is None:
            return False
        process.task.lacks_memory = True
        return True
