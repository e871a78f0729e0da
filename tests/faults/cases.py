"""A case of the campaign: what is disturbed, how and when, all drawn from one seed."""

from __future__ import annotations

import random
from dataclasses import dataclass

from tests.faults.kinds import EVERYBODY, RESULTS, SIGNALS, Fault
from tests.faults.moments import Moment
from tests.faults.variants import VARIANTS, Variant

PATIENT_SECONDS = 30.0
"""The longest outage where all interruptions are short: nothing may end the run, however busy the machine is."""
HASTY_SECONDS = 3.0
"""The same where some are longer than it."""

_WEIGHTS = {
    "kill": 24,
    "stop": 14,
    "flap": 16,
    "cut": 12,
    "silence": 6,
    "fill the disk": 5,
    "rename": 3,
    "remove": 2,
    **dict.fromkeys(SIGNALS, 6),
}
_PHASES = {"start": 25, "run": 50, "finish": 25}


@dataclass(frozen=True)
class Case:
    """Drawn from `seed`, and nothing else."""

    seed: int
    variant: Variant
    faults: tuple[Fault, ...]
    longest_outage: float

    @property
    def wired(self) -> set[str]:
        """The processes that need a cable."""
        names = {fault.target for fault in self.faults if fault.kind in ("flap", "cut", "silence")}
        return {*self.variant.processes, *names} if EVERYBODY in names else names

    @property
    def options(self) -> list[str]:
        """Arguments of `evedrop run`, in addition to those of the variant."""
        return ["--set", f"longest_outage={self.longest_outage}"]

    @property
    def fills(self) -> bool:
        """Whether the disk is filled."""
        return any(fault.kind == "fill the disk" for fault in self.faults)

    def __str__(self) -> str:
        return f"{self.variant.name}: {'; '.join(map(str, self.faults))}"


def case_of(seed: int) -> Case:
    """The case of a seed."""
    draw = random.Random(f"faults {seed}")  # noqa: S311 - a campaign must be repeatable
    variant = draw.choice(list(VARIANTS.values()))
    hasty = draw.random() < 0.2
    faults = [_fault(draw, variant, hasty)]
    for _ in range(draw.choices((0, 1, 2), (5, 3, 2))[0]):
        faults.append(_fault(draw, variant, hasty))
    return Case(seed, variant, tuple(faults), HASTY_SECONDS if hasty else PATIENT_SECONDS)


def _fault(draw: random.Random, variant: Variant, hasty: bool) -> Fault:
    (kind,) = draw.choices([*_WEIGHTS], [*_WEIGHTS.values()])
    phase = draw.choices([*_PHASES], [*_PHASES.values()])[0]
    moment = Moment(phase, round(draw.random(), 3))
    shard = draw.randrange(variant.shards)
    target, seconds, count = _target(draw, kind, variant), None, 1
    if kind == "flap":
        count, seconds = draw.randint(1, 30), draw.uniform(0.1, 2.0)
    elif kind in ("stop", "cut", "silence"):
        seconds = draw.uniform(0.05, 1.2)
        if hasty and target != "launcher" and draw.random() < 0.5:
            # An outage is noticed when the lease of a connection, some seconds, has run out.
            seconds = draw.choice((None, draw.uniform(3.0, 14.0)))
    return Fault(kind, target, moment, shard, None if seconds is None else round(seconds, 2), count)


def _target(draw: random.Random, kind: str, variant: Variant) -> str:
    if kind in ("fill the disk", "rename", "remove"):
        return RESULTS
    peers = [name for name in variant.processes if name != "router"]
    if kind in ("flap", "cut", "silence"):
        return draw.choice([*peers, EVERYBODY])
    others = ["launcher", "router"]
    if kind in SIGNALS:
        others += ["launcher"] * 4
    return draw.choice([*peers, *others])
