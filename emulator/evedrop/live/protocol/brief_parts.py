"""The part of a brief that depends on the role: everything that a process of this role may know of the scenario.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from evedrop.live.protocol.brief_closed_loop import (
    AssignmentEntry,
    EstimatorLoopPart,
    MonitorEntry,
    PlantEntry,
    SensorLoopPart,
    SensorPlantEntry,
    Wiring,
)
from evedrop.live.protocol.keys import KINDS
from evedrop.model.acknowledgements import AckChannelSpec
from evedrop.model.entries import (
    MATRIX,
    NUMBERS,
    SLOT,
    Check,
    anything,
    entry,
    flag,
    inner,
    listed,
    maybe,
    named,
    not_negative,
    number,
    read,
    row,
    table,
    table_of,
    text,
    whole,
)
from evedrop.model.links.link import Fate
from evedrop.model.noise_distribution import NoiseDistribution
from evedrop.model.numeric.detection import Chart
from evedrop.model.slot.link import NEVER, Change, LinkSchedule, ReceiverOutage
from evedrop.model.streams import MOST_SLOTS

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


def _noise(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a matrix or a word."""
    yield from (text if isinstance(found, str) else MATRIX)(path, found)


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
        outages = [[one.start, one.stop, int(one.reason)] for one in schedule.outages]
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
