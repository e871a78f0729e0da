"""Faults that are drawn for some runs only: they hit a run at few moments, or are those of other programs beside it.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, final

from evedrop.errors import RunError, UsageError
from evedrop.live.launch.metrics_server import MetricsAddress, RunMetrics
from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.scenario.tables import Scenario
from evedrop.system.world import world as here
from evedrop.virtual.broken_messages import BreakMessage
from evedrop.virtual.by_hand import RunByHand, RunWrongly, WriteBriefs
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_faults import events_of
from evedrop.virtual.faults import CutConnection, RenameResults
from evedrop.virtual.moments import COMMANDS, DECISIONS, FINAL_BELIEFS, PROGRESS_OF_RECEIVERS
from evedrop.virtual.outsiders import ChangeLink, OperatorCommand, PauseRun
from evedrop.virtual.processes import LAUNCHER
from evedrop.virtual.rereading import RereadMessages

if TYPE_CHECKING:
    from evedrop.virtual.run import SimulatedWorld

_ONE_IN = 3
"""How many runs there are for each with such a fault."""
_ADDRESSES = {
    "127.0.0.1:0": "",
    "localhost:9464": "",
    "[::1]:9464": "",
    "0.0.0.0:9464": "can read the metrics",
    "[::]:9464": "can read the metrics",
    "::1:9464": "is not an address and a port",
    "127.0.0.1:99999": "is not an address and a port",
    "nowhere": "is not an address and a port",
}
"""Where metrics can be served → what somebody who does so is told."""
_STEERING = (("pause",), ("step", "1"), ("step", "3"), ("resume",))
_COMMANDS, _RESUME_SECONDS = 4, 0.5
_READINGS, _BETWEEN_SECONDS = 5, 0.1
_NOTABLE = 0.5
"""The fraction of wrong messages that are commands, or other rarer ones."""
_ACCOMPANIED = 0.4
"""The fraction of faults with another one before them, which makes what they hit less usual."""


@final
class TakePort(Disturbance):
    """Another program listens where a router is to listen."""

    kind, share = "take the port of", 2

    @classmethod
    def targets(cls, scenario: Scenario) -> Sequence[str]:
        """Routers; those of one machine alone have no port."""
        return [ROUTER, *([RELAY] if scenario.relayed else [])]

    def strike(self, world: SimulatedWorld) -> bool:
        """Listen there, once nobody else does."""
        place = world.places.get(self.target)
        if place is not None:
            world.zenoh.occupy(place)
        return place is not None

    @property
    def statuses(self) -> frozenset[int]:
        """That of a launcher which finds it taken, and that of a router which cannot listen."""
        return frozenset({UsageError.exit_status, RunError.exit_status})

    @property
    def blamed(self) -> tuple[str, ...]:
        """What cannot be done there."""
        return ("listen", self.target)

    @property
    def named_first(self) -> bool:
        """Whether it is in the first line: no, if a process on another host meets the other program before the router tries."""
        return False


@final
class ReadMetrics(Disturbance):
    """Somebody reads the metrics of a run while it goes on, and at its end."""

    kind, share = "read the metrics of", 2
    only_target, harmless = "run", True

    def strike(self, world: SimulatedWorld) -> bool:
        """Read them."""
        world.machine.begin("reader", lambda: self._read(world))
        return True

    def _read(self, world: SimulatedWorld) -> int:
        for text, problem in _ADDRESSES.items():
            try:
                said = MetricsAddress.of(text).warning or ""
            except UsageError as error:
                said = str(error)
            if problem not in said or bool(problem) != bool(said):
                raise AssertionError(f"who serves metrics at {text} is told {said}")
        for _ in range(_READINGS):
            self._scrape(world)
            here().sleep(_BETWEEN_SECONDS)
        while world.process(LAUNCHER) is not None:
            here().sleep(1.0)
        self._scrape(world)
        return 0

    @staticmethod
    def _scrape(world: SimulatedWorld) -> None:
        assert world.scenario is not None  # noqa: S101 - it is run
        told = [*world.told]
        metrics = RunMetrics(world.scenario, world.results, lambda _: None)
        for _, event in told:
            metrics.on_event(event)
        with closing(metrics):
            samples = [sample for family in metrics.collect() for sample in family.samples]
        values = {sample.name: sample.value for sample in samples}
        slots, planned = values["evedrop_slots_total"], values["evedrop_slots_planned"]
        if not 0 <= slots <= planned == world.scenario.slots:
            raise AssertionError(f"the metrics say {slots} of {planned} slots")


@final
class SteerRun(OperatorCommand):
    """Two operators pause the run, let it do steps and resume it, without regard to each other."""

    kind, share = "steer", 3

    def strike(self, world: SimulatedWorld) -> bool:
        """Begin both."""
        super().strike(world)
        return super().strike(world)

    def _act(self, world: SimulatedWorld) -> int:
        some = random.Random(here().token(8))  # noqa: S311 - to be repeated, not to be secret
        for _ in range(_COMMANDS):
            self._type(world, *some.choice(_STEERING))
            here().sleep(some.uniform(0.0, 0.3))
        while not self._type(world, "resume") and world.process(LAUNCHER) is not None:
            here().sleep(_RESUME_SECONDS)
        return 0


RARE_KINDS: Mapping[str, type[Disturbance]] = {
    kind.kind: kind
    for kind in (
        BreakMessage,
        ReadMetrics,
        RereadMessages,
        RunByHand,
        RunWrongly,
        SteerRun,
        TakePort,
        WriteBriefs,
    )
}
_WITH: Mapping[type[Disturbance], Sequence[tuple[type[Disturbance], float | None]]] = {
    BreakMessage: ((PauseRun, 0.5), (ChangeLink, None), (CutConnection, 0.3)),
    ReadMetrics: ((PauseRun, 1.0), (RenameResults, None)),
    RereadMessages: ((PauseRun, 0.5), (ChangeLink, None), (CutConnection, 0.3)),
}
"""Kind → those of which one may come with it, and for how long that lasts."""


def rare_faults(seed: int, scenario: Scenario, ahead: int) -> tuple[Disturbance, ...]:
    """What else happens to the run of a seed; ahead: as in `events_of`."""
    some = random.Random(f"rare {seed}")  # noqa: S311 - to be repeated, not to be secret
    if some.random() * _ONE_IN >= 1.0:
        return ()
    [kind] = some.choices([*RARE_KINDS.values()], [kind.share for kind in RARE_KINDS.values()])
    target = some.choice(kind.targets(scenario))
    last = events_of(scenario, ahead)
    after = int(some.uniform(1, last) if some.random() < 0.5 else max(2.0, last) ** some.random())
    seconds = round(10.0 ** some.uniform(-2.0, 1.0), 3) if kind.lasts and some.random() < 0.6 else None
    fault = kind(target, 1 if kind.early else after, seconds)
    if kind is BreakMessage and some.random() < _NOTABLE:
        moment = some.choice(_notable(target, scenario))
        fault = kind(target, some.choice((1, 1, 1, 2, 2, 3)), None, moment)
    if kind in _WITH and some.random() < _ACCOMPANIED:
        other, lasting = some.choice(_WITH[kind])
        return other(some.choice(other.targets(scenario)), int(after * some.random()) + 1, lasting), fault
    return (fault,)


def _notable(target: str, scenario: Scenario) -> list[str]:
    """The moments at which a message to a process is of a rarer kind."""
    if target != RECORDER:
        return [COMMANDS]
    leaves = any(scenario.timeline.outages.values())
    return [PROGRESS_OF_RECEIVERS, *[FINAL_BELIEFS] * leaves, *[DECISIONS] * (scenario.controller is not None)]
