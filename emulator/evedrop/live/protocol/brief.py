"""Briefs: a brief has everything that one process may know; the launcher writes it, and its path is the only argument.

A brief is `<process>.json`, mode 0600. It holds the keys of the streams that the process owns; only the recorder's brief holds
the scenario's seed. A part of it depends on the role: what a process of this role may know of the scenario, and, in a closed
loop, of the plant, its disturbances, and the controller's assignment and connections.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

import json
import os
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeGuard, TypeVar

import numpy as np

from evedrop.errors import BriefError
from evedrop.live.protocol.keys import KINDS
from evedrop.model.acknowledgements import AckChannelSpec
from evedrop.model.controllers import Assignment
from evedrop.model.detection import Chart
from evedrop.model.entries import (
    LIMITS,
    MATRIX,
    NUMBERS,
    SLOT,
    Check,
    anything,
    entry,
    expect,
    flag,
    inner,
    key,
    listed,
    maybe,
    named,
    not_negative,
    number,
    plain,
    read,
    row,
    table,
    table_of,
    text,
    whole,
)
from evedrop.model.integrity.monitor import MonitorPlan, Suspicion
from evedrop.model.links.loss_model import Fate
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, mistakes_of
from evedrop.model.schedule import NoiseDistribution
from evedrop.model.slot.link import NEVER, Change, LinkSchedule, ReceiverOutage
from evedrop.model.streams import MOST_SLOTS, Batch
from evedrop.system.files import Unreadable, opened, why_of

Matrix = Sequence[Sequence[float]]
Limits = Sequence[float | None]
"""None for a limit that does not exist."""


def encoded(disturbances: Floats) -> str:
    """Disturbances (slots, q) as text for a brief: little-endian float64 in base64."""
    return b64encode(disturbances.astype("<f8").tobytes()).decode()


def decoded(disturbances: str, slots: int) -> Floats:
    """The disturbances of a brief, (slots, q). Raises ValueError if the slots do not all have equally many."""
    return np.frombuffer(b64decode(disturbances), "<f8").reshape(slots, -1)


@dataclass(frozen=True, kw_only=True)
class PlantEntry:
    """A plant as plain numbers."""

    input_matrix: Matrix = field(metadata=entry(MATRIX))
    disturbance_matrix: Matrix = field(metadata=entry(MATRIX))
    noise: Matrix = field(metadata=entry(MATRIX))
    start: Sequence[float] = field(metadata=entry(NUMBERS))
    output_matrix: Matrix | None = field(default=None, metadata=entry(MATRIX, left_out=True))
    """Only if the sensor filters."""
    measurement_noise: Matrix | None = field(default=None, metadata=entry(MATRIX, left_out=True))
    input_lower: Limits = field(metadata=entry(LIMITS))
    input_upper: Limits = field(metadata=entry(LIMITS))
    state_lower: Limits = field(metadata=entry(LIMITS))
    state_upper: Limits = field(metadata=entry(LIMITS))

    @classmethod
    def of(cls, plant: Plant, **own: str) -> Self:
        """The entry of a plant; own: further entries of a subclass."""
        measured = ("output_matrix", "measurement_noise") if plant.output_matrix is not None else ()
        matrices = ("input_matrix", "disturbance_matrix", "noise", "start", *measured)
        limits = ("input_lower", "input_upper", "state_lower", "state_upper")
        entries: dict[str, Any] = {name: getattr(plant, name).tolist() for name in matrices}
        entries |= {name: _with_none(getattr(plant, name)) for name in limits} | own
        return cls(**entries)

    @property
    def plant(self) -> Plant:
        """The plant. Raises ValueError if its matrices do not fit together."""
        n = len(self.start)
        measured = {
            name: np.array(value)
            for name in ("output_matrix", "measurement_noise")
            if (value := getattr(self, name)) is not None
        }
        return Plant(
            input_lower=_limits(self.input_lower, -np.inf),
            input_upper=_limits(self.input_upper, np.inf),
            state_lower=_limits(self.state_lower, -np.inf),
            state_upper=_limits(self.state_upper, np.inf),
            input_matrix=np.array(self.input_matrix, np.float64).reshape(n, -1),
            disturbance_matrix=np.array(self.disturbance_matrix, np.float64).reshape(n, -1),
            noise=np.array(self.noise),
            start=np.array(self.start),
            **measured,
        )


@dataclass(frozen=True, kw_only=True)
class SensorPlantEntry(PlantEntry):
    """The plant of a sensor, which knows the disturbances."""

    disturbances: str = field(metadata=entry(text))
    """As `encoded`."""


@dataclass(frozen=True)
class MonitorEntry:
    """The watermark, the detector for the sensor's filter and the attack on its measurements, as plain numbers."""

    watermark: Matrix = field(metadata=entry(MATRIX))
    """Σ_e."""
    shift: Matrix = field(metadata=entry(MATRIX))
    """G, as in `MonitorPlan`."""
    unmarked: Matrix = field(metadata=entry(MATRIX))
    """T⁻¹ after a slot without watermark."""
    unmarked_log_det: float = field(metadata=entry(number))
    marked: Matrix = field(metadata=entry(MATRIX))
    """T⁻¹ after a slot with one."""
    marked_log_det: float = field(metadata=entry(number))
    policy: str = field(metadata=entry(text))
    parameters: Mapping[str, float] = field(metadata=entry(named(number)))
    attack: str | None = field(metadata=entry(maybe(text)))
    """None if nobody attacks."""
    attack_data: Mapping[str, Any] = field(metadata=entry(named(anything)))
    spans: Sequence[tuple[int, int]] = field(metadata=entry(listed(row(SLOT, SLOT))))
    """The slots [from, to) of the attack."""

    @classmethod
    def of(cls, plan: MonitorPlan) -> MonitorEntry:
        """The entry of a plan."""
        return cls(
            plan.watermark.tolist(),
            plan.shift.tolist(),
            plan.unmarked.precision.tolist(),
            plan.unmarked.log_det,
            plan.marked.precision.tolist(),
            plan.marked.log_det,
            plan.policy,
            dict(plan.parameters),
            plan.attack,
            dict(plan.attack_data),
            [(start, stop) for start, stop in plan.spans],
        )

    @property
    def plan(self) -> MonitorPlan:
        """The plan."""
        return MonitorPlan(
            np.array(self.watermark, np.float64),
            np.array(self.shift, np.float64),
            Suspicion(np.array(self.unmarked, np.float64), self.unmarked_log_det),
            Suspicion(np.array(self.marked, np.float64), self.marked_log_det),
            self.policy,
            self.parameters,
            self.attack,
            self.attack_data,
            self.spans,
        )


@dataclass(frozen=True)
class AssignmentEntry:
    """A controller's assignment as plain numbers, without process and plant."""

    period: int = field(metadata=entry(whole(1)))
    slot_seconds: float = field(metadata=entry(not_negative))
    state_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    input_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    rate_weights: Sequence[float] = field(metadata=entry(NUMBERS))
    rate_limits: Limits = field(metadata=entry(LIMITS))
    parameters: Mapping[str, Any] = field(metadata=entry(named(anything)))

    @classmethod
    def of(cls, assignment: Assignment) -> AssignmentEntry:
        """The entry of an assignment."""
        return cls(
            assignment.period,
            assignment.slot_seconds,
            assignment.state_weights.tolist(),
            assignment.input_weights.tolist(),
            assignment.rate_weights.tolist(),
            _with_none(assignment.rate_limits),
            dict(assignment.parameters),
        )

    def assignment(self, process: Process, plant: Plant) -> Assignment:
        """The assignment for a process and a plant."""
        return Assignment(
            process,
            plant,
            self.period,
            self.slot_seconds,
            np.array(self.state_weights, np.float64),
            np.array(self.input_weights, np.float64),
            np.array(self.rate_weights, np.float64),
            _limits(self.rate_limits, np.inf),
            self.parameters,
        )


@dataclass(frozen=True)
class Wiring:
    """A controller's connections, for the routers."""

    acts_on: str = field(metadata=entry(text))
    """`estimate` or `truth`."""
    knows_input: bool = field(metadata=entry(flag))
    """Whether the legitimate estimator receives the inputs."""

    @property
    def on_truth(self) -> bool:
        """Whether the controller receives the true state."""
        return self.acts_on == "truth"


@dataclass(frozen=True)
class SensorLoopPart:
    """The sensor's part in the loop."""

    period: int = field(metadata=entry(whole(1)))
    """Slots between decisions."""
    acts_on: str = field(metadata=entry(text))
    """As in `Wiring`."""


@dataclass(frozen=True)
class EstimatorLoopPart(SensorLoopPart):
    """The legitimate estimator's part in the loop."""

    plant: PlantEntry | None = field(metadata=inner(PlantEntry, or_null=True))
    """None if it does not know the inputs."""


def _with_none(limits: Floats) -> Limits:
    return [value if np.isfinite(value) else None for value in limits.tolist()]


def _limits(limits: Limits, without: float) -> Floats:
    return np.array([without if value is None else value for value in limits], np.float64)


_TEXTS = listed(text)
_SCHEME = table({"scheme": text}, strict=False)
_SIZES = table(dict.fromkeys(KINDS, whole(1)))
_WINDOW = whole(0, MOST_SLOTS)
_OUTAGES = listed(row(SLOT, SLOT, flag))
_SCORE = whole(-NEVER)
_CHART: Check = maybe(table(dict.fromkeys(("acknowledged", "missing", "threshold"), _SCORE)))
_ACK_CHANNEL: Check = maybe(
    table(
        {
            "quality": number,
            "attack": text,
            "jammer": maybe(text),
            "spans": maybe(listed(row(SLOT, SLOT))),
            "flip": number,
            "overheard": number,
        }
    )
)
_CHANGES = listed(table({"at": SLOT, "settings": maybe(named(anything)), "cut": maybe(flag)}))


def _noise(path: str, value: Any) -> Iterator[str]:
    """Check that a value is a matrix or a word."""
    yield from (text if isinstance(value, str) else MATRIX)(path, value)


@dataclass(frozen=True)
class Identity:
    """A process's certificate and key, and the authority that it trusts; each in PEM."""

    authority: str = field(metadata=entry(text))
    """The certificate of the run's authority, which made all certificates of the run."""
    certificate: str = field(metadata=entry(text))
    key: str = field(repr=False, metadata=entry(text))
    """The private key of the certificate."""


@dataclass(frozen=True)
class LinkEntry:
    """The schedule of a link as plain values."""

    settings: Mapping[str, Any] = field(metadata=entry(table({"loss": named(anything)}, strict=False)))
    window: int = field(metadata=entry(_WINDOW))
    changes: Sequence[Change] = field(metadata=entry(_CHANGES, lambda found: [Change(**one) for one in found]))
    outages: Sequence[Sequence[int]] = field(metadata=entry(listed(row(SLOT, SLOT, SLOT))))
    """For each: first slot, first slot after, and the `Fate` of its packets."""
    correlation: tuple[str, float] | None = field(
        metadata=entry(maybe(row(text, number)), lambda found: None if found is None else tuple(found))
    )
    """The receiver whose link's losses these are tied to, and the strength; None if they are independent."""

    @classmethod
    def of(cls, schedule: LinkSchedule) -> LinkEntry:
        """The entry of a link's schedule."""
        outages = [[outage.start, outage.stop, int(outage.reason)] for outage in schedule.outages]
        return cls(schedule.settings, schedule.window, schedule.changes, outages, schedule.correlation)

    @property
    def schedule(self) -> LinkSchedule:
        """The link's schedule. Raises ValueError if an outage has no such `Fate`."""
        outages = tuple(ReceiverOutage(start, stop, Fate(reason)) for start, stop, reason in self.outages)
        return LinkSchedule(self.settings, self.window, tuple(self.changes), outages, self.correlation)


@dataclass(frozen=True)
class RouterPart:
    """The router's part: all links, and the credentials of all users."""

    role: ClassVar[str] = "router"
    links: Mapping[str, LinkEntry] = field(
        metadata=entry(
            named(table_of(LinkEntry)), lambda found: {name: read(LinkEntry, one) for name, one in found.items()}
        )
    )
    """Receiver → the schedule of its link."""
    pace: float = field(metadata=entry(not_negative))
    """Seconds per slot; 0: as fast as possible."""
    users: Mapping[str, str] = field(repr=False, metadata=entry(named(text)))
    """User → password."""
    leaks: Mapping[str, int] = field(metadata=entry(named(SLOT)))
    """Receiver → the slot whose state it learns."""
    acknowledgements: AckChannelSpec | None = field(
        metadata=entry(_ACK_CHANNEL, lambda found: None if found is None else AckChannelSpec(**found))
    )
    controller: Wiring | None = field(metadata=inner(Wiring, or_null=True))
    zid: str | None = field(metadata=entry(maybe(text)))
    """The router's Zenoh id, if there is a relay."""
    limits: Mapping[str, int] = field(metadata=entry(_SIZES))
    """Kind of key → bytes of its largest message."""
    modules: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """The folder in which modules of classes that are not built in are looked for, after everything installed."""


@dataclass(frozen=True)
class RelayPart:
    """The relay's part."""

    role: ClassVar[str] = "relay"
    users: Mapping[str, str] = field(repr=False, metadata=entry(named(text)))
    """User of its site → password."""
    receivers: Sequence[str] = field(metadata=entry(_TEXTS))
    listen: str = field(metadata=entry(text))
    """The endpoint where it listens."""
    zid: str = field(metadata=entry(text))
    """The router's Zenoh id."""
    controller: Wiring | None = field(metadata=inner(Wiring, or_null=True))
    limits: Mapping[str, int] = field(metadata=entry(_SIZES))
    """As the router's."""


@dataclass(frozen=True)
class ProgramEntry:
    """The program that publishes the states, and the form of its messages."""

    key: str = field(metadata=entry(text))
    states: Sequence[str] = field(metadata=entry(_TEXTS))
    """The names of the states."""
    reference: Sequence[float] = field(metadata=entry(NUMBERS))
    """The states' reference, from which deviations are transmitted."""
    connect: str | None = field(default=None, metadata=entry(text, left_out=True))
    """The endpoint to connect to; None to listen."""
    listen: str | None = field(default=None, metadata=entry(text, left_out=True))
    """The endpoint to listen on."""
    offsets: Sequence[int] | None = field(default=None, metadata=entry(listed(whole(0)), left_out=True))
    """Where in a message each state is, in bytes, as f8; None: messages are JSON."""


@dataclass(frozen=True)
class SensorPart:
    """The sensor's part."""

    role: ClassVar[str] = "sensor"
    scheme: Mapping[str, Any] = field(metadata=entry(_SCHEME))
    """`scheme`, its name, and its parameters."""
    pace: float = field(metadata=entry(not_negative))
    """As the router's."""
    receivers: Sequence[str] = field(metadata=entry(_TEXTS))
    holds: Sequence[int] = field(metadata=entry(listed(SLOT)))
    """Slots before which it holds."""
    history: int = field(metadata=entry(_WINDOW))
    """How many slots before the first that is not done a restarted router must receive again."""
    leaks: Mapping[str, int] = field(metadata=entry(named(SLOT)))
    """As the router's."""
    chart: Chart | None = field(metadata=entry(_CHART, lambda found: None if found is None else Chart(**found)))
    """The chart with which it detects attacks on acknowledgements; None if it does not."""
    plant: SensorPlantEntry | None = field(metadata=inner(SensorPlantEntry, or_null=True))
    controller: SensorLoopPart | None = field(metadata=inner(SensorLoopPart, or_null=True))
    modules: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """As the router's."""
    monitor: MonitorEntry | None = field(default=None, metadata=inner(MonitorEntry, left_out=True))
    """None without a detector for its filter."""
    states: str | None = field(default=None, metadata=entry(text, left_out=True))
    """Given states of all slots, as deviations, as `brief_closed_loop.encoded`; None if they are not known before the run."""
    program: ProgramEntry | None = field(default=None, metadata=inner(ProgramEntry, left_out=True))
    """The program that gives the states; None if none does."""


@dataclass(frozen=True)
class LegitimatePart:
    """The legitimate estimator's part."""

    role: ClassVar[str] = "legitimate"
    scheme: Mapping[str, Any] = field(metadata=entry(_SCHEME))
    """As the sensor's."""
    window: int = field(metadata=entry(_WINDOW))
    """Slots by which a packet may be late."""
    outages: Sequence[tuple[int, int, bool]] = field(metadata=entry(_OUTAGES))
    """For each: first slot, first slot after, and whether it keeps its state."""
    controller: EstimatorLoopPart | None = field(metadata=inner(EstimatorLoopPart, or_null=True))
    """None if it has no part in the loop."""
    modules: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """As the router's."""
    state_file: str | None = field(default=None, metadata=entry(text, left_out=True))
    """The file in which it keeps its state."""


@dataclass(frozen=True)
class EavesdropperPart:
    """An eavesdropper's part."""

    role: ClassVar[str] = "eavesdropper"
    strategy: str = field(metadata=entry(text))
    parameters: Mapping[str, Any] = field(metadata=entry(named(anything)))
    """The strategy's parameters."""
    window: int = field(metadata=entry(_WINDOW))
    """As the legitimate estimator's."""
    outages: Sequence[tuple[int, int, bool]] = field(metadata=entry(_OUTAGES))
    """As the legitimate estimator's."""
    noise_covariance: Any = field(default=None, metadata=entry(_noise, left_out=True))
    """The covariance of packets that hold noise in place of a state, as in the scenario; None if the scheme sends none."""
    modules: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """As the router's."""
    state_file: str | None = field(default=None, metadata=entry(text, left_out=True))
    """As the legitimate estimator's."""

    @property
    def noise_distribution(self) -> NoiseDistribution | None:
        """The distribution of these packets; None if there are none."""
        return None if self.noise_covariance is None else NoiseDistribution(self.noise_covariance)


@dataclass(frozen=True)
class ControllerPart:
    """The controller's part."""

    role: ClassVar[str] = "controller"
    strategy: str = field(metadata=entry(text))
    assignment: AssignmentEntry = field(metadata=inner(AssignmentEntry))
    acts_on: str = field(metadata=entry(text))
    """As in `Wiring`."""
    plant: PlantEntry = field(metadata=inner(PlantEntry))
    disturbances: str = field(metadata=entry(text))
    """As `brief_closed_loop.encoded`."""


@dataclass(frozen=True)
class RecorderPart:
    """The recorder's part: everything about the run."""

    role: ClassVar[str] = "recorder"
    scenario: Mapping[str, Any] = field(repr=False, metadata=entry(named(anything)))
    """The whole scenario, with its seed."""
    results: str = field(metadata=entry(text))
    """The results folder."""
    recording: bool = field(metadata=entry(flag))
    """Whether to write a recording for the view."""
    operator: str = field(repr=False, metadata=entry(text))
    """The operator's password."""
    shard: bool = field(metadata=entry(flag))
    """Whether the run is a shard of a larger one."""
    paused: bool = field(metadata=entry(flag))
    """Whether it holds the run before slot 0, until the operator lets it continue."""
    operator_identity: Identity | None = field(metadata=inner(Identity, or_null=True))
    classes: Mapping[str, Mapping[str, Any]] = field(metadata=entry(named(named(anything))))
    """Question → answer, of eavesdroppers' classes that are not built in."""


RoutingPart = RouterPart | RelayPart
ReceiverPart = LegitimatePart | EavesdropperPart
ImportingPart = RouterPart | SensorPart | LegitimatePart | EavesdropperPart
"""Parts of roles that may import classes that are not built in."""
Part = RouterPart | RelayPart | SensorPart | LegitimatePart | EavesdropperPart | ControllerPart | RecorderPart
PARTS: Mapping[str, type[Part]] = {
    kind.role: kind
    for kind in (RouterPart, RelayPart, SensorPart, LegitimatePart, EavesdropperPart, ControllerPart, RecorderPart)
}
"""Role → its part."""


_MOST_TRIALS, _LAST_TRIAL = 1_000_000, 2**48
_MOST_BYTES = 2**30  # the recorder's brief holds the complete scenario
WRITE_AGAIN = "write it again with `evedrop brief`"


@dataclass(frozen=True)
class Flow:
    """End-to-end flow control, both in slots."""

    window: int = field(metadata=entry(whole(1)))
    """The sensor is at most this far ahead of the slowest receiver and of the recorder."""
    batch: int = field(metadata=entry(whole(1)))
    """Telemetry, journal and progress are sent at least this often."""
    longest_outage: float = field(default=30.0, metadata=entry(not_negative))
    """Seconds for which a process may be cut off before that ends the run."""
    largest_message: int = field(default=2**30, metadata=entry(whole(1)))
    """Bytes of the largest message of the run: larger ones are not accepted."""


@dataclass(frozen=True)
class Model:
    """The public model, which every process may know."""

    A: list[list[float]] = field(metadata=entry(MATRIX))
    Q: list[list[float]] = field(metadata=entry(MATRIX))
    initial_covariance: list[list[float]] = field(metadata=entry(MATRIX))
    state_probability: float = field(metadata=entry(number))
    """μ_d; its mean over the slots if it differs from slot to slot."""
    header: int = field(default=0, metadata=entry(whole(0, 64)))
    """How many unencrypted numbers a packet has in addition to its payload."""
    singular_noise: bool = field(default=False, metadata=entry(flag))
    """Whether Q may be singular."""
    state_probabilities: tuple[float, ...] | None = field(default=None, metadata=entry(NUMBERS, tuple, left_out=True))
    """μ_d(k) for every slot; None if it is the same in all slots."""

    @property
    def process(self) -> Process:
        """The process of the model."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)


P_co = TypeVar("P_co", bound=Part, covariant=True)
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, kw_only=True)
class Brief(Generic[P_co]):
    """Everything one process may know."""

    run: str = field(metadata=entry(text))
    process: str = field(metadata=entry(text))
    role: str = field(metadata=entry(text))
    router: str = field(metadata=entry(text))
    """Zenoh endpoint, such as unixsock-stream/PATH or tls/127.0.0.1:17460."""
    user: str = field(metadata=entry(text))
    password: str = field(repr=False, metadata=entry(text))
    slots: int = field(metadata=entry(whole(1, MOST_SLOTS)))
    trials: int = field(metadata=entry(whole(1, _MOST_TRIALS)))
    first_trial: int = field(metadata=entry(whole(0, _LAST_TRIAL)))
    recorded: int = field(metadata=entry(whole(1, _MOST_TRIALS)))
    """How many of the first trials are recorded in full."""
    flow: Flow = field(metadata=inner(Flow))
    model: Model = field(metadata=inner(Model))
    keys: Mapping[str, str] = field(repr=False, metadata=entry(named(key)))
    """Stream name → key, hexadecimal: the streams this process owns."""
    part: P_co = field(metadata=entry(named(anything)))
    """The role's part of the scenario."""
    first: int = field(default=0, metadata=entry(whole(0, MOST_SLOTS)))
    """The first slot that this process handles; above 0 for a restarted receiver."""
    ends_with_stdin: bool = field(metadata=entry(flag))
    """End when standard input closes: the launcher holds its other end, so nothing outlives a killed launcher."""
    patience: int = field(default=30, metadata=entry(whole(1)))
    """Seconds for which it waits for the other processes to appear."""
    identity: Identity | None = field(default=None, metadata=inner(Identity, or_null=True))
    """Its identity, if the run's router takes certificates."""
    last_word: str | None = field(default=None, metadata=entry(maybe(text), left_out=True))
    """The file for its last word (`evedrop.live.protocol.last_word`); None for a process that is started by hand."""

    @property
    def batch(self) -> Batch:
        """The slots and trials of the run."""
        return Batch(self.slots, self.trials, self.first_trial)

    @property
    def stream_keys(self) -> dict[str, bytes]:
        """The keys of the streams this process owns."""
        return {name: bytes.fromhex(key) for name, key in self.keys.items()}

    @property
    def entries(self) -> Mapping[str, Any]:
        """The brief as plain tables, lists, texts and numbers."""
        return dict(json.loads(self.text))

    @property
    def text(self) -> str:
        """The brief as JSON."""
        return json.dumps(self, default=plain, indent=1)

    def write(self, directory: Path) -> Path:
        """Write `<process>.json`, readable by its owner only."""
        path = directory / f"{self.process}.json"
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(self.text)
        return path


AnyBrief = Brief[Part]


def has_part(brief: AnyBrief, kind: type[P]) -> TypeGuard[Brief[P]]:
    """Whether a brief has this kind of part, which says its role."""
    return isinstance(brief.part, kind)


def read_brief(path: Path, role: str | None = None) -> AnyBrief:
    """Read and check a brief. Raises BriefError if it is unreadable, readable by others, malformed, or another role's."""
    try:
        with opened(path) as file:
            status = os.fstat(file.fileno())
            if status.st_mode & 0o077:
                raise BriefError(f"{path} is readable by others; a brief holds keys: chmod 600 {path}")
            content = file.read(_MOST_BYTES) if status.st_size <= _MOST_BYTES else None
    except (OSError, Unreadable) as error:
        raise BriefError(f"{path}: {why_of(error)}; give the file that `evedrop brief` wrote") from error
    try:
        if content is None:
            raise ValueError(f"it has more than {_MOST_BYTES} bytes")
        brief = brief_from(json.loads(content.decode("utf-8")))
    except (ValueError, RecursionError) as error:
        raise BriefError(f"{path} is not a brief of this version ({error}); {WRITE_AGAIN}") from error
    if role is not None and brief.role != role:
        raise BriefError(
            f"{path} is the brief of a {brief.role}; expected one of a {role}: start `evedrop {brief.role}`"
        )
    return brief


def brief_from(entries: Any) -> AnyBrief:
    """The brief of a decoded JSON text. Raises ValueError if it is not one."""
    expect(table_of(Brief), "", entries)
    if entries["role"] not in PARTS:
        raise ValueError(f"unknown role {entries['role']:.40}, expected one of {', '.join(PARTS)}")
    kind = PARTS[entries["role"]]
    expect(table_of(kind), "part", entries["part"])
    brief: AnyBrief = read(Brief, {**entries, "part": read(kind, entries["part"])})
    model = brief.model
    try:
        matrices = [np.array(M, np.float64) for M in (model.A, model.Q, model.initial_covariance)]
    except (ValueError, OverflowError) as error:
        raise ValueError("model.A, model.Q or model.initial_covariance is not a matrix") from error
    if wrong := mistakes_of(matrices[0], matrices[1], matrices[2], model.singular_noise):
        raise ValueError(f"its model is not a process: model.{wrong[0][0]} {wrong[0][1]}")
    if not 0.0 <= model.state_probability <= 1.0:
        raise ValueError(f"model.state_probability is {model.state_probability}, expected a number from 0 to 1")
    if model.state_probabilities is not None:
        wrong_number = len(model.state_probabilities) != brief.slots
        if wrong_number or not all(0.0 <= probability <= 1.0 for probability in model.state_probabilities):
            raise ValueError(f"model.state_probabilities are not {brief.slots} numbers from 0 to 1, one for each slot")
    return brief
