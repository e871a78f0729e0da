"""A case of the campaign: what is disturbed, how and when, all drawn from one seed."""

from __future__ import annotations

import random
from dataclasses import dataclass

from tests.faults.disturbed import CLEANER, FORK_SERVERS
from tests.faults.hosts import (
    CONNECTION,
    HOST_CLEANER,
    HOST_FORK_SERVER,
    PROGRAM,
    SESSION,
    SSH,
    target_on,
)
from tests.faults.kinds import CONFUSED, EVERYBODY, LIMITS, NEEDS, NETWORK, RESULTS, SIGNALS, Fault
from tests.faults.moments import Moment
from tests.faults.studies import StudyCase, study_case
from tests.faults.variants import HOSTED, VARIANTS, Variant
from tests.faults.wires import WireCase, wire_case

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
    "break the disk": 3,
    "rename": 3,
    "remove": 2,
    "stop and kill": 5,
    CONFUSED: 5,
    "few processes": 4,
    "little memory": 4,
    **dict.fromkeys(SIGNALS, 6),
}
FAMILIES = {"live": 84, "wire": 9, "study": 7}
_PHASES = {"start": 25, "run": 50, "finish": 25}
_OVER_SSH = (16, 15)
"""Numbers with this remainder, when divided by the first, are runs over ssh, drawn separately: all others stay as they were."""
_PARTS = {SSH: 25, PROGRAM: 25, SESSION: 20, CONNECTION: 20, HOST_FORK_SERVER: 7, HOST_CLEANER: 3}
_ON_HOSTS = {"kill": 5, "stop": 6, "stop and kill": 3, **dict.fromkeys(SIGNALS, 2)}


_CONDITIONS = {CONFUSED: "confused", **{kind: limit[0] for kind, limit in LIMITS.items()}}


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
        names = {fault.target for fault in self.faults if fault.kind in NETWORK}
        return {*self.variant.processes, *names} if EVERYBODY in names else names

    @property
    def options(self) -> list[str]:
        """Arguments of `evedrop run`, in addition to those of the variant."""
        return ["--set", f"longest_outage={self.longest_outage}"]

    @property
    def disk(self) -> str | None:
        """The disk that its results need: `full`, `broken`, or None."""
        kinds = {fault.kind for fault in self.faults}
        return "broken" if "break the disk" in kinds else "full" if "fill the disk" in kinds else None

    @property
    def limits(self) -> dict[str, int]:
        """The conditions under which the run is started: `memory`, `processes`, `confused`."""
        return {_CONDITIONS[fault.kind]: fault.count for fault in self.faults if fault.kind in _CONDITIONS}

    @property
    def needs(self) -> set[str]:
        """The facilities that its faults need."""
        over_ssh = {"sshd"} if self.variant.hosts else set()
        return {NEEDS[fault.kind] for fault in self.faults if fault.kind in NEEDS} | over_ssh

    def __str__(self) -> str:
        return f"{self.variant.name}: {'; '.join(map(str, self.faults))}"


AnyCase = Case | WireCase | StudyCase


def case_of(seed: int) -> AnyCase:
    """The case of a seed."""
    count, remainder = _OVER_SSH
    if seed % count == remainder:
        return _case_over_ssh(seed)
    draw = random.Random(f"faults {seed}")  # noqa: S311 - a campaign must be repeatable
    (family,) = draw.choices([*FAMILIES], [*FAMILIES.values()])
    if family == "wire":
        return wire_case(seed, draw)
    if family == "study":
        return study_case(seed, draw)
    variant = draw.choice(list(VARIANTS.values()))
    hasty = draw.random() < 0.2
    faults = [_fault(draw, variant, hasty)]
    for _ in range(draw.choices((0, 1, 2), (5, 3, 2))[0]):
        faults.append(_fault(draw, variant, hasty))
    if limits := [fault for fault in faults if fault.kind in LIMITS]:
        faults = limits[:1]  # whatever else happens, the run may end for this reason
    if any(fault.kind == "break the disk" for fault in faults):
        faults = [fault for fault in faults if fault.kind != "fill the disk"]
    return Case(seed, variant, tuple(faults), HASTY_SECONDS if hasty else PATIENT_SECONDS)


def _fault(draw: random.Random, variant: Variant, hasty: bool) -> Fault:
    (kind,) = draw.choices([*_WEIGHTS], [*_WEIGHTS.values()])
    phase = draw.choices([*_PHASES], [*_PHASES.values()])[0]
    moment = Moment(phase, round(draw.random(), 3))
    shard = draw.randrange(variant.shards)
    target, seconds, count = _target(draw, kind, variant), None, 1
    if kind == CONFUSED:
        return Fault(kind, EVERYBODY, Moment("start", 0.0), count=draw.randint(20, 200))
    if kind in LIMITS:
        return Fault(kind, "launcher", Moment("start", 0.0), count=draw.randint(*LIMITS[kind][1:]))
    if kind == "flap":
        count, seconds = draw.randint(1, 30), draw.uniform(0.1, 2.0)
    elif kind in ("stop", "stop and kill", "cut", "silence"):
        # At its start a run waits for two minutes for a fork server that is suspended for good.
        waits = target == "launcher" or (target in FORK_SERVERS and phase == "start")
        seconds = _lasting(draw, hasty and not waits)
    return Fault(kind, target, moment, shard, None if seconds is None else round(seconds, 2), count)


def _lasting(draw: random.Random, long: bool) -> float | None:
    """How long something lasts; None for good. long: whether it may be longer than a second."""
    seconds = draw.uniform(0.05, 1.2)
    if long and draw.random() < 0.5:
        # An outage is noticed when the lease of a connection, some seconds, has run out.
        return draw.choice((None, draw.uniform(3.0, 14.0)))
    return seconds


def _case_over_ssh(seed: int) -> Case:
    """A run that is spread over hosts; its first fault, at least, disturbs a part of one of them."""
    draw = random.Random(f"faults over ssh {seed}")  # noqa: S311 - a campaign must be repeatable
    variant = draw.choice(list(HOSTED.values()))
    hasty = draw.random() < 0.2
    faults = [_fault_on_host(draw, variant, hasty)]
    for _ in range(draw.choices((0, 1, 2), (5, 3, 2))[0]):
        faults.append(_fault_on_host(draw, variant, hasty) if draw.random() < 0.5 else _other(draw, variant, hasty))
    return Case(seed, variant, tuple(faults), HASTY_SECONDS if hasty else PATIENT_SECONDS)


def _other(draw: random.Random, variant: Variant, hasty: bool) -> Fault:
    """A fault of a process of the run, of the network, or of the launcher."""
    while True:
        fault = _fault(draw, variant, hasty)
        if fault.kind not in LIMITS and fault.kind != CONFUSED and fault.target != RESULTS:
            return fault


def _fault_on_host(draw: random.Random, variant: Variant, hasty: bool) -> Fault:
    (part,) = draw.choices([*_PARTS], [*_PARTS.values()])
    target = target_on(part, draw.choice([*variant.hosts]))
    phase = draw.choices([*_PHASES], [*_PHASES.values()])[0]
    moment = Moment(phase, round(draw.random(), 3))
    if part == CONNECTION:
        kind = draw.choice(NETWORK)
    elif part in (HOST_FORK_SERVER, HOST_CLEANER):
        kind = draw.choice(("kill", "stop"))
    else:
        (kind,) = draw.choices([*_ON_HOSTS], [*_ON_HOSTS.values()])
    if kind == "flap":
        return Fault(kind, target, moment, seconds=round(draw.uniform(0.1, 2.0), 2), count=draw.randint(1, 5))
    if kind not in ("stop", "stop and kill", "silence", "cut"):
        return Fault(kind, target, moment)
    # What is suspended for good at the start is waited for, for a minute or two.
    seconds = _lasting(draw, hasty and phase != "start")
    if kind == "stop" and part in (PROGRAM, SSH) and phase != "start" and draw.random() < 0.4:
        seconds = None
    return Fault(kind, target, moment, seconds=None if seconds is None else round(seconds, 2))


def _target(draw: random.Random, kind: str, variant: Variant) -> str:
    if kind in ("fill the disk", "break the disk", "rename", "remove"):
        return RESULTS
    if kind == "stop and kill":
        return "launcher"
    peers = [name for name in variant.processes if name != "router"]
    if kind in NETWORK:
        return draw.choice([*peers, EVERYBODY])
    others = ["launcher", "router"]
    if kind in SIGNALS:
        others += ["launcher"] * 4
    else:
        others += [*FORK_SERVERS, CLEANER]
    return draw.choice([*peers, *others])
