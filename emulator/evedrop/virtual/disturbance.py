"""What all faults of the simulated world have in common: what they hit, when, and what a run promises when they happen.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from evedrop.errors import RunError, UsageError
from evedrop.names import CONTROLLER, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.scenario.tables import Scenario
from evedrop.virtual.host_parts import host_of
from evedrop.virtual.moments import EVENTS
from evedrop.virtual.processes import FORK_SERVERS

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

EVERYBODY = "everybody"
"""All processes that are connected with a router."""
ROUTERS = (ROUTER, RELAY)
KILLED = -9
"""The status of a process that was killed."""


@dataclass(frozen=True)
class Disturbance(ABC):
    """Something that happens to a run."""

    target: str
    """The process that it hits."""
    after: int
    """The number of events in the world, or of those that `moment` names, after which it strikes."""
    seconds: float | None = None
    """How long it lasts; None for good, or where it does not last."""
    moment: str = EVENTS
    """What `after` counts, such as "barriers"."""

    kind: ClassVar[str]
    share: ClassVar[float]
    """How often it is drawn, in comparison with others: a process can be hit at any message, and a disk at few moments."""
    lasts: ClassVar[bool] = False
    """Whether it has a duration."""
    most_seconds: ClassVar[float] = 10.0
    for_good: ClassVar[bool] = True
    """Whether it may last for good, if it lasts."""
    lacking: ClassVar[bool] = False
    """Whether programs lack something, so that not all is written."""
    destroys: ClassVar[bool] = False
    """Whether nobody can look at the results afterwards."""
    amends: ClassVar[bool] = False
    """Whether it changes the scenario of the run, which then has other results."""
    cuts_off: ClassVar[bool] = False
    """Whether all that it does is to cut its target off from the others."""
    early: ClassVar[bool] = False
    """Whether it strikes before everything else."""
    loses: ClassVar[bool] = True
    """Whether even a brief one may cost more time than it lasts, because messages may be lost."""
    only_target: ClassVar[str]
    """What it hits, if that is the same in every run."""
    harmless: ClassVar[bool | None] = None
    """Whether a run always survives it, or need not; None: it survives a short one."""

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """What it may hit in a run of a scenario; a name that comes twice is drawn twice as often."""
        del scenario
        return [cls.only_target]

    @abstractmethod
    def strike(self, world: SimulatedWorld) -> bool:
        """Do it; returns whether it hit anything."""

    def survived(self, longest_outage: float) -> bool:
        """Whether the run must go on to its end as if nothing had happened."""
        if self.harmless is not None:
            return self.harmless
        return self.seconds is not None and self.seconds < longest_outage / 2.0

    def ends_at_once(self, process: str) -> bool:
        """Whether it may end a process before that can write or remove anything."""
        return process == RECORDER and self.target in FORK_SERVERS

    @property
    def blamed(self) -> tuple[str, ...]:
        """What a failure that it causes may name: who is cut off cannot tell who is at fault."""
        if self.target in FORK_SERVERS:
            return ("fork server",)
        if host := host_of(self.target):
            return (f"host {host}",)
        return (self.target, *(ROUTERS if self.target in (RECORDER, EVERYBODY, *ROUTERS) else ()))

    @property
    def named_first(self) -> bool:
        """Whether the first line of a failure that it causes names it; otherwise a log does, whose last lines are shown, too."""
        return not self.lacking and self.target != EVERYBODY

    @property
    def statuses(self) -> frozenset[int]:
        """The exit statuses with which a run may end because of it."""
        return frozenset({RunError.exit_status, *([UsageError.exit_status] if host_of(self.target) else [])})

    @property
    def awaited_seconds(self) -> float:
        """For how long a run may wait because of it, besides the longest outage."""
        return 0.0

    def __str__(self) -> str:
        lasting = "" if not self.lasts else " for good" if self.seconds is None else f" for {self.seconds:.2f} s"
        return f"{self.kind} {self.target}{lasting} after {self.after} {self.moment}"


def processes_of(scenario: Scenario) -> tuple[str, ...]:
    """The processes that the launcher of a scenario starts."""
    relay = (RELAY,) if scenario.relayed else ()
    controller = (CONTROLLER,) if scenario.controller is not None else ()
    return (ROUTER, *relay, SENSOR, *scenario.receivers, *controller, RECORDER)
