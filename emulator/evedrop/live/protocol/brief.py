"""Briefs: a brief has everything that one process may know; the launcher writes it, and its path is the only argument.

A brief is `<process>.json`, mode 0600. It holds the keys of the streams that the process owns; only the recorder's brief holds
the scenario's seed. A part of it depends on the role: what a process of this role may know of the scenario, and, in a closed
loop, of the plant, its disturbances, and the controller's assignment and connections.

A process makes the objects that it needs once, before it takes part in a run (`expect_usable`): a brief that it cannot use is
refused with the entry that is to blame.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

import json
import os
from base64 import b64decode, b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeGuard, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from evedrop.errors import BriefError, NotRegistered, UsageError
from evedrop.live.protocol.json_tables import plain, read
from evedrop.live.protocol.keys import KINDS
from evedrop.live.protocol.last_word import last_word_file
from evedrop.model.acknowledgements import ATTACKS, AckChannelSpec
from evedrop.model.controllers import CONTROLLERS, Assignment
from evedrop.model.detection import Chart
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper
from evedrop.model.eavesdroppers.readers import READERS
from evedrop.model.integrity import POLICIES, SENSOR_ATTACKS
from evedrop.model.integrity.monitor import Monitor, MonitorPlan
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, mistakes_of
from evedrop.model.schedule import NoiseDistribution
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import Link, LinkSchedule, streams_of
from evedrop.model.staircase import Staircase
from evedrop.model.streams import KEY_BYTES, LAST_TRIAL, MOST_SLOTS, Batch
from evedrop.names import ACKNOWLEDGEMENTS
from evedrop.system.fields import Finite, NotNegative, Probability, Slot
from evedrop.system.files import Unreadable, opened, why_of
from evedrop.system.world import world

Positive = Annotated[int, Meta(ge=1, le=2**62)]
Window = Annotated[int, Meta(ge=0, le=MOST_SLOTS)]
Trials = Annotated[int, Meta(ge=1, le=1_000_000)]
Chunk = Annotated[str, Meta(pattern=r"\A[^/*$?#]{1,250}\Z")]
"""A name that is a part of Zenoh's keys."""
Key = Annotated[str, Meta(pattern=rf"\A[0-9a-fA-F]{{{2 * KEY_BYTES}}}\Z")]
"""The key of a stream, in hexadecimal."""
Outage = tuple[Slot, Slot, bool]
"""A receiver's outage: first slot, first slot after, and whether it keeps its state."""
Matrix = Sequence[Sequence[Finite]]


def encoded(disturbances: Floats) -> str:
    """Disturbances (slots, q) as text for a brief: little-endian float64 in base64."""
    return b64encode(disturbances.astype("<f8").tobytes()).decode()


def decoded(disturbances: str, slots: int) -> Floats:
    """The disturbances of a brief, (slots, q). Raises ValueError if the slots do not all have equally many."""
    return np.frombuffer(b64decode(disturbances), "<f8").reshape(slots, -1)


@dataclass(frozen=True)
class Wiring:
    """A controller's connections, for the routers."""

    acts_on: str
    """`estimate` or `truth`."""
    knows_input: bool
    """Whether the legitimate estimator receives the inputs."""

    @property
    def on_truth(self) -> bool:
        """Whether the controller receives the true state."""
        return self.acts_on == "truth"


@dataclass(frozen=True)
class SensorLoopPart:
    """The sensor's part in the loop."""

    period: Positive
    """Slots between decisions."""
    acts_on: str
    """As in `Wiring`."""


@dataclass(frozen=True)
class EstimatorLoopPart(SensorLoopPart):
    """The legitimate estimator's part in the loop."""

    plant: Plant | None
    """None if it does not know the inputs."""


@dataclass(frozen=True)
class Identity:
    """A process's certificate and key, and the authority that it trusts; each in PEM."""

    authority: str
    """The certificate of the run's authority, which made all certificates of the run."""
    certificate: str
    key: str = field(repr=False)
    """The private key of the certificate."""


def _expect_kinds(limits: Mapping[str, int]) -> None:
    """Raise ValueError unless there is a limit for each kind of key."""
    for kind in set(KINDS) ^ set(limits):
        raise ValueError(f"`{kind:.40}` of part.limits is missing, or no kind of key")


@dataclass(frozen=True)
class RouterPart:
    """The router's part: all links, and the credentials of all users."""

    role: ClassVar[str] = "router"
    links: Mapping[Chunk, LinkSchedule]
    """Receiver → the schedule of its link."""
    pace: NotNegative
    """Seconds per slot; 0: as fast as possible."""
    users: Mapping[str, str] = field(repr=False)
    """User → password."""
    leaks: Mapping[str, Slot]
    """Receiver → the slot whose state it learns."""
    acknowledgements: AckChannelSpec | None
    controller: Wiring | None
    zid: str | None
    """The router's Zenoh id, if there is a relay."""
    limits: Mapping[str, Positive]
    """Kind of key → bytes of its largest message."""
    modules: str | None = None
    """The folder in which modules of classes that are not built in are looked for, after everything installed."""

    def __post_init__(self) -> None:
        _expect_kinds(self.limits)

    def expect_usable(self, brief: AnyBrief) -> None:
        """Make the links, also as they are after each change, and look for the keys of their streams."""
        for name, schedule in self.links.items():
            brief.expect_keys(streams_of(name, schedule))
            keys = {stream: brief.stream_keys[stream] for stream in streams_of(name, schedule)}
            later = [change.settings for change in schedule.changes if change.settings is not None]
            with _using(f"part.links.{name}"):
                schedule.expect_possible()
                for settings in (schedule.settings, *later):
                    Link(replace(schedule, settings=settings), name, keys, brief.batch)
        if self.acknowledgements is not None:
            brief.expect_keys([f"link/{ACKNOWLEDGEMENTS}"])
            if self.acknowledgements.attack not in ATTACKS:
                raise BriefError(f"part.acknowledgements.attack is {self.acknowledgements.attack:.40}; {WRITE_AGAIN}")


@dataclass(frozen=True)
class RelayPart:
    """The relay's part."""

    role: ClassVar[str] = "relay"
    users: Mapping[str, str] = field(repr=False)
    """User of its site → password."""
    receivers: Sequence[Chunk]
    listen: str
    """The endpoint where it listens."""
    zid: str
    """The router's Zenoh id."""
    controller: Wiring | None
    limits: Mapping[str, Positive]
    """As the router's."""

    def __post_init__(self) -> None:
        _expect_kinds(self.limits)

    def expect_usable(self, brief: AnyBrief) -> None:
        """There is nothing to make."""


@dataclass(frozen=True)
class ProgramPart:
    """The program that publishes the states, and the form of its messages."""

    key: str
    states: Sequence[str]
    """The names of the states."""
    reference: Sequence[Finite]
    """The states' reference, from which deviations are transmitted."""
    connect: str | None = None
    """The endpoint to connect to; None to listen."""
    listen: str | None = None
    """The endpoint to listen on."""
    offsets: Sequence[Slot] | None = None
    """Where in a message each state is, in bytes, as f8; None: messages are JSON."""

    def expect_usable(self, n: int) -> None:
        """Raise ValueError unless it gives n states, and there is one way to connect with it."""
        if {len(self.states), len(self.reference), len(self.offsets or self.states)} != {n}:
            raise ValueError(f"it does not have {n} states, as the model does")
        if (self.connect is None) == (self.listen is None):
            raise ValueError("it needs connect or listen, and not both")


@dataclass(frozen=True)
class SensorPart:
    """The sensor's part."""

    role: ClassVar[str] = "sensor"
    scheme: Mapping[str, Any]
    """`scheme`, its name, and its parameters."""
    pace: NotNegative
    """As the router's."""
    receivers: Sequence[Chunk]
    holds: Sequence[Slot]
    """Slots before which it holds."""
    history: Window
    """How many slots before the first that is not done a restarted router must receive again."""
    leaks: Mapping[str, Slot]
    """As the router's."""
    chart: Chart | None
    """The chart with which it detects attacks on acknowledgements; None if it does not."""
    plant: Plant | None
    controller: SensorLoopPart | None
    disturbances: str | None = None
    """Of the plant, as `encoded`; None without a plant."""
    modules: str | None = None
    """As the router's."""
    monitor: MonitorPlan | None = None
    """None without a detector for its filter."""
    states: str | None = None
    """Given states of all slots, as deviations, as `encoded`; None if they are not known before the run."""
    program: ProgramPart | None = None
    """The program that gives the states; None if none does."""

    @property
    def filters(self) -> bool:
        """Whether it filters."""
        return self.plant is not None and self.plant.output_matrix is not None

    def expect_usable(self, brief: AnyBrief) -> None:
        """Make the scheme and the monitor, and look for the keys of all streams."""
        scheme, n = _scheme(brief, self.scheme), brief.model.process.n
        own = ["process", *(["measurement"] if self.filters else [])]
        brief.expect_keys([*own, *(["watermark", "spoofing"] if self.monitor else []), *scheme.secret_streams])
        if self.plant is not None:
            if self.disturbances is None:
                raise BriefError(f"part.disturbances is missing, which moves the plant; {WRITE_AGAIN}")
            _expect_plant(brief, "part.plant", self.plant, self.disturbances)
        with _using("part.monitor"):
            if self.monitor is not None:
                if self.plant is None or self.plant.output_matrix is None:
                    raise ValueError("there is no filter whose innovations could be tested")
                self.monitor.expect_sizes(len(self.plant.output_matrix), self.plant.inputs)
                policy, attack, data = POLICIES[self.monitor.policy], self.monitor.attack, self.monitor.attack_data
                _expect_no_more("part.monitor.parameters", self.monitor.parameters, policy.parameters)
                _expect_right("part.monitor.parameters", policy.mistakes(self.monitor.parameters))
                entries = {} if attack is None else SENSOR_ATTACKS[attack].read(data).plain
                _expect_no_more("part.monitor.attack_data", data, entries)
                Monitor(self.monitor, bytes(KEY_BYTES), brief.batch)
                self.monitor.spoofing(bytes(KEY_BYTES), brief.batch)
        with _using("part.states"):
            if self.states is not None:
                _expect_numbers(decoded(self.states, brief.slots), n, "states")
        with _using("part.program"):
            if self.program is not None:
                self.program.expect_usable(n)


@dataclass(frozen=True)
class LegitimatePart:
    """The legitimate estimator's part."""

    role: ClassVar[str] = "legitimate"
    scheme: Mapping[str, Any]
    """As the sensor's."""
    window: Window
    """Slots by which a packet may be late."""
    outages: Sequence[Outage]
    controller: EstimatorLoopPart | None
    """None if it has no part in the loop."""
    modules: str | None = None
    """As the router's."""
    state_file: str | None = None
    """The file in which it keeps its state."""

    def expect_usable(self, brief: AnyBrief) -> None:
        """Make the scheme, and look for the keys of its streams, and the absence before a restart."""
        _expect_return(brief, self.outages)
        brief.expect_keys(_scheme(brief, self.scheme).estimator_streams)
        if self.controller is not None and self.controller.plant is not None:
            _expect_plant(brief, "part.controller.plant", self.controller.plant)


@dataclass(frozen=True)
class EavesdropperPart:
    """An eavesdropper's part."""

    role: ClassVar[str] = "eavesdropper"
    strategy: str
    parameters: Mapping[str, Any]
    """The strategy's parameters."""
    window: Window
    """As the legitimate estimator's."""
    outages: Sequence[Outage]
    noise_covariance: str | Matrix | None = None
    """The covariance of packets that hold noise in place of a state, as in the scenario; None if the scheme sends none."""
    modules: str | None = None
    """As the router's."""
    state_file: str | None = None
    """As the legitimate estimator's."""

    @property
    def noise_distribution(self) -> NoiseDistribution | None:
        """The distribution of these packets; None if there are none."""
        return None if self.noise_covariance is None else NoiseDistribution(self.noise_covariance)

    def expect_usable(self, brief: AnyBrief) -> None:
        """Look for the class, its parameters, the keys of its streams and the absence before a restart; make the noise."""
        _expect_return(brief, self.outages)
        kind, n, noise = STRATEGIES[self.strategy], brief.model.process.n, self.noise_distribution
        with _using("part.parameters"):
            self._expect_parameters(kind)
            entries = {*kind.parameters}
            if "reads_as" in kind.parameters:
                reader = READERS[self.parameters["reads_as"]]
                self._expect_parameters(reader)
                entries |= {*reader.parameters}
            _expect_no_more("part.parameters", self.parameters, entries)
            streams = kind.streams(self.parameters)
        brief.expect_keys(streams)
        if kind.reads_leaks:
            with _using("model"):
                Staircase(brief.model.process)
        with _using("part.noise_covariance"):
            if noise is not None and noise.factors(brief.model.process)(range(1, 2)).shape[1:] != (n, n):
                raise ValueError(f"it does not have {n} states, as the model does")

    def _expect_parameters(self, kind: type[Eavesdropper]) -> None:
        """Raise BriefError unless the parameters of a strategy, or of the one that it reads as, are there and right."""
        lacking = sorted(set(kind.parameters) - set(self.parameters))
        if lacking:
            raise BriefError(f"part.parameters.{lacking[0]} is missing, which the strategy needs; {WRITE_AGAIN}")
        _expect_right("part.parameters", kind.mistakes(self.parameters))


@dataclass(frozen=True)
class ControllerPart:
    """The controller's part."""

    role: ClassVar[str] = "controller"
    strategy: str
    assignment: Assignment
    acts_on: str
    """As in `Wiring`."""
    disturbances: str
    """As `encoded`."""

    def expect_usable(self, brief: AnyBrief) -> None:
        """Look for the class, and ask it whether it can do the assignment."""
        if self.strategy not in CONTROLLERS:
            names = ", ".join(sorted(CONTROLLERS))
            raise BriefError(f"part.strategy is {self.strategy:.40}, expected one of {names}; {WRITE_AGAIN}")
        _expect_plant(brief, "part.assignment.plant", self.assignment.plant, self.disturbances)
        with _using("part.assignment"):
            given, own = brief.model.process, self.assignment.process
            if not all(np.array_equal(*two) for two in zip(given.matrices, own.matrices, strict=True)):
                raise ValueError("its process is not that of the model")
            kind, parameters = CONTROLLERS[self.strategy], self.assignment.parameters
            _expect_no_more("part.assignment.parameters", parameters, kind.parameters)
            _expect_right("part.assignment.parameters", kind.mistakes(parameters))
            objections = kind.objections(self.assignment)
        if objections:
            raise BriefError(f"part: the {objections[0][0]} {objections[0][1]}")


@dataclass(frozen=True)
class RecorderPart:
    """The recorder's part: everything about the run."""

    role: ClassVar[str] = "recorder"
    scenario: Mapping[str, Any] = field(repr=False)
    """The whole scenario, with its seed."""
    results: str
    """The results folder."""
    recording: bool
    """Whether to write a recording for the view."""
    operator: str = field(repr=False)
    """The operator's password."""
    shard: bool
    """Whether the run is a shard of a larger one."""
    paused: bool
    """Whether it holds the run before slot 0, until the operator lets it continue."""
    operator_identity: Identity | None
    classes: Mapping[str, Mapping[str, Any]]
    """Question → answer, of eavesdroppers' classes that are not built in."""

    def expect_usable(self, brief: AnyBrief) -> None:
        """The recorder checks the scenario itself."""


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


def _expect_return(brief: AnyBrief, outages: Sequence[Outage]) -> None:
    """Raise BriefError unless a receiver begins with the run, or with the slot after an outage."""
    if brief.first and all(stop != brief.first for _, stop, _ in outages):
        raise BriefError(f"first is {brief.first}, where no outage of {brief.process} ends; {WRITE_AGAIN}")


def _scheme(brief: AnyBrief, spec: Mapping[str, Any]) -> Scheme:
    name = spec.get("scheme")
    if not isinstance(name, str):
        raise BriefError(f"part.scheme.scheme is missing, or no name; {WRITE_AGAIN}")
    kind = SCHEMES[name]
    for parameter in sorted(set(kind.parameters) ^ (set(spec) - {"scheme"})):
        problem = "missing" if parameter in kind.parameters else "not a parameter of the scheme"
        raise BriefError(f"part.scheme.{parameter} is {problem}; {WRITE_AGAIN}")
    with _using("part.scheme"):
        _expect_right("part.scheme", kind.mistakes(spec))
        return scheme_of(brief.model.process, spec)


def _expect_right(path: str, mistakes: Iterable[tuple[str, str]]) -> None:
    """Raise BriefError for the first mistake that a class has found in its parameters."""
    for parameter, problem in mistakes:
        raise BriefError(f"{path}.{parameter} {problem}; {WRITE_AGAIN}")


def _expect_no_more(path: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Raise BriefError for an entry that a class does not know: that of another version may mean something by it."""
    for name in sorted({*given} - {*known}):
        raise BriefError(f"{path}.{name:.40} is not an entry that is known here; {WRITE_AGAIN}")


def _expect_plant(brief: AnyBrief, path: str, plant: Plant, disturbances: str | None = None) -> None:
    n = brief.model.process.n
    with _using(path):
        plant.expect_possible()
        if plant.start.shape != (n,):
            raise ValueError(f"it does not have {n} states, as the model does")
    with _using("part.disturbances"):
        if disturbances is not None:
            _expect_numbers(decoded(disturbances, brief.slots), plant.disturbance_matrix.shape[1], "disturbances")


def _expect_numbers(series: Floats, count: int, names: str) -> None:
    """Raise ValueError unless there are finite numbers, this many in each slot; names: of what they are."""
    if series.shape[1] != count or not np.isfinite(series).all():
        raise ValueError(f"it has {series.shape[1]} {names}, not {count}, or they are not finite")


@contextmanager
def _using(path: str) -> Iterator[None]:
    """Turn any error in the block into a BriefError that names the part of the brief."""
    try:
        yield
    except (BriefError, NotRegistered):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
        raise BriefError(f"{path} cannot be used ({reason}); {WRITE_AGAIN}") from error


@contextmanager
def classes_known() -> Iterator[None]:
    """Turn a NotRegistered of the block into a BriefError: the brief names a class that this process does not have."""
    try:
        yield
    except NotRegistered as error:
        name = str(error.name).encode("unicode_escape").decode()
        raise BriefError(f"it names {name}{error.why or ', which is not a class here'}") from error


_MOST_BYTES = 2**30  # the recorder's brief holds the complete scenario
WRITE_AGAIN = "write it again with `evedrop brief`"


@dataclass(frozen=True)
class Flow:
    """End-to-end flow control, both in slots."""

    window: Positive
    """The sensor is at most this far ahead of the slowest receiver and of the recorder."""
    batch: Positive
    """Telemetry, journal and progress are sent at least this often."""
    longest_outage: NotNegative = 30.0
    """Seconds for which a process may be cut off before that ends the run."""
    largest_message: Positive = 2**30
    """Bytes of the largest message of the run: larger ones are not accepted."""
    largest_report: Positive = 2**30
    """Bytes of the largest message of telemetry or of the journal, which bounds what may wait to be read."""
    message: Positive = 1
    """A message carries the packets of at most this many slots."""


@dataclass(frozen=True)
class Model:
    """The public model, which every process may know."""

    A: list[list[Finite]]
    Q: list[list[Finite]]
    initial_covariance: list[list[Finite]]
    state_probability: Probability
    """μ_d; its mean over the slots if it differs from slot to slot."""
    header: Annotated[int, Meta(ge=0, le=64)] = 0
    """How many unencrypted numbers a packet has in addition to its payload."""
    singular_noise: bool = False
    """Whether Q may be singular."""
    state_probabilities: tuple[Probability, ...] | None = None
    """μ_d(k) for every slot; None if it is the same in all slots."""

    def __post_init__(self) -> None:
        try:
            A, Q, covariance = (np.array(M, np.float64) for M in (self.A, self.Q, self.initial_covariance))
        except ValueError as error:
            raise ValueError("A, Q or initial_covariance is not a matrix") from error
        if mistakes := mistakes_of(A, Q, covariance, self.singular_noise):
            raise ValueError(f"it is not a process: {mistakes[0][0]} {mistakes[0][1]}")

    @property
    def process(self) -> Process:
        """The process of the model."""
        return Process(np.array(self.A), np.array(self.Q), np.array(self.initial_covariance), self.singular_noise)


P_co = TypeVar("P_co", bound=Part, covariant=True)
P = TypeVar("P", bound=Part)


@dataclass(frozen=True, kw_only=True)
class Brief(Generic[P_co]):
    """Everything one process may know."""

    run: Chunk
    process: Chunk
    role: str
    router: str
    """Zenoh endpoint, such as unixsock-stream/PATH or tls/127.0.0.1:17460."""
    user: str
    password: str = field(repr=False)
    slots: Annotated[int, Meta(ge=1, le=MOST_SLOTS)]
    trials: Trials
    first_trial: Annotated[int, Meta(ge=0, le=LAST_TRIAL)]
    recorded: Trials
    """How many of the first trials are recorded in full."""
    flow: Flow
    model: Model
    keys: Mapping[str, Key] = field(repr=False)
    """Stream name → key, hexadecimal: the streams this process owns."""
    part: P_co
    """The role's part of the scenario."""
    first: Window = 0
    """The first slot that this process handles; above 0 for a restarted receiver."""
    ends_with_stdin: bool
    """End when standard input closes: the launcher holds its other end, so nothing outlives a killed launcher."""
    patience: Positive = 30
    """Seconds for which it waits for the other processes to appear."""
    identity: Identity | None = None
    """Its identity, if the run's router takes certificates."""
    last_word: str | None = None
    """The file for its last word (`evedrop.live.protocol.last_word`); None for a process that is started by hand."""

    def __post_init__(self) -> None:
        probabilities = self.model.state_probabilities
        if probabilities is not None and len(probabilities) != self.slots:
            raise ValueError(f"model.state_probabilities are not {self.slots} numbers, one for each slot")

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
        return msgspec.json.format(json.dumps(self, default=plain), indent=1)

    def write(self, directory: Path) -> Path:
        """Write `<process>.json`, readable by its owner only. Raises UsageError if it is larger than its process reads."""
        path, content = directory / f"{self.process}.json", self.text.encode()
        if len(content) > _MOST_BYTES:
            raise UsageError(
                f"the brief of {self.process} has {len(content)} bytes, and a process reads at most {_MOST_BYTES}: each event "
                "that sets entries of a link contains its recorded losses and delays; give fewer events, or shorter recordings"
            )
        world().disk.write(path, content)
        return path

    @classes_known()
    def expect_usable(self) -> None:
        """Raise BriefError if a process cannot work with it: a key, a class or a number is missing or unusable."""
        self.part.expect_usable(self)

    def expect_keys(self, names: Iterable[str]) -> None:
        """Raise BriefError unless there are the keys of all these streams."""
        for name in names:
            if name not in self.keys:
                raise BriefError(f"keys.{name} is missing, and {self.process} cannot work without it; {WRITE_AGAIN}")


AnyBrief = Brief[Part]


def has_part(brief: AnyBrief, kind: type[P]) -> TypeGuard[Brief[P]]:
    """Whether a brief has this kind of part, which says its role."""
    return isinstance(brief.part, kind)


def with_files_in(brief: AnyBrief, folder: Path) -> AnyBrief:
    """The brief with the files of its process in a folder: its last word and, if it is to go away, its state meanwhile."""
    brief = replace(brief, last_word=str(last_word_file(folder, brief.process)))
    if not isinstance(brief.part, ReceiverPart) or not brief.part.outages:
        return brief
    state_file = str((folder / f"{brief.process}.state").absolute())
    return replace(brief, part=replace(brief.part, state_file=state_file))


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
        brief = brief_from(msgspec.json.decode(content))
    except (ValueError, RecursionError) as error:
        raise BriefError(f"{path} is not a brief of this version ({error}); {WRITE_AGAIN}") from error
    if role is not None and brief.role != role:
        raise BriefError(
            f"{path} is the brief of a {brief.role}; expected one of a {role}: start `evedrop {brief.role}`"
        )
    return brief


def brief_from(entries: Any) -> AnyBrief:
    """The brief of a decoded JSON text. Raises ValueError if it is not one."""
    role = entries.get("role") if isinstance(entries, dict) else None
    kind = PARTS.get(role) if isinstance(role, str) else None
    if kind is None:
        raise ValueError(f"role is {role!r:.40}, expected one of {', '.join(PARTS)}")
    brief: AnyBrief = read(Brief[kind], entries)  # type: ignore[valid-type]
    return brief
