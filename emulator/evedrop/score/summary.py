"""The contents of summary.json as typed classes: `Summary`, and a class for each kind of entry in it.

The fields of a class are the entry's keys, in their order. Entries of applications and metrics of receivers are open:
packages add to them.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

from msgspec import Struct, structs, to_builtins

from evedrop.errors import UnknownName
from evedrop.model.metrics import METRICS
from evedrop.model.metrics.built_in import LinkAccount
from evedrop.model.metrics.text import estimate
from evedrop.scenario import application
from evedrop.scenario.progress_events import ConnectionOutage, RunEvent
from evedrop.score.verdict import Verdict
from evedrop.system.structs import converted

if TYPE_CHECKING:
    from pydantic import TypeAdapter


JudgedValue = float | int | str | None
"""The value found for an expectation. None: the run does not tell, or a receiver that must be synchronised never was."""


StandardErrors = Mapping[str, float | Mapping[str, float | None] | None]
"""Metric → its standard error, None if it has none; for metrics by name, such as those of receivers, a further mapping."""
MODES: Mapping[str, str] = {
    "live": "",
    "exact": "",
    "covariance-only": " --covariance-only",
    "error-coordinates": " --error-coordinates",
}
"""The mode of a run → the option of `evedrop montecarlo` that chooses it, after a space."""
RARE_FRACTION = 0.1
"""The fraction of an expected error that rare events may carry without being reported; beyond it, a mean error has no z-score."""


@dataclass(frozen=True)
class RareEvents:
    """The events that carry a receiver's expected error, but that too few trials meet."""

    fraction: float
    """The fraction of the expected error that comes from events that are expected fewer than 20 times in all trials."""
    trials: float
    """The number of trials for which this fraction would be RARE_FRACTION."""


@dataclass(frozen=True)
class RareEstimate:
    """A receiver's mean error by splitting, which contains the rare events that carry it."""

    mean_error: float | None
    """None: not to be trusted, for the reason in `doubt`."""
    standard_error: float | None
    z: float | None
    """Its z-score against its expectation by theory; None if that is unknown."""
    populations: int
    trials: int
    """The trials of each population."""
    splits: int
    """After how many slots trials were copied."""
    counting: float
    """The least fraction of trials that counted in a slot, in the mean over populations."""
    doubt: str | None
    slots: Mapping[str, Sequence[float]]
    """`mean_error` and `standard_error` of every slot; empty if they are not to be trusted."""


@dataclass(frozen=True)
class PeerSummary:
    """The entry of a receiver; its built-in metrics are attributes, each None if it has no value."""

    metrics: Mapping[str, float | None]
    """Name of the metric → its value; None if it has none."""
    error_quantiles: Mapping[str, float] | None
    infinite_variance: bool
    digest: str | None
    mode_metrics: Mapping[str, float | None] = field(default_factory=dict)
    """The metrics that only the run's mode has."""
    standard_errors: Mapping[str, float | None] = field(default_factory=dict)
    """Name of a metric → its standard error, for metrics that are estimated; None if it has none."""
    z: Mapping[str, float | None] = field(default_factory=dict)
    """Name of a metric that theory expects → its z-score; None if that is unknown, or rare events carry too much of it."""
    rare_events: RareEvents | None = None
    """None: unknown."""
    rare_estimate: RareEstimate | None = None
    """None, and left out of the entry: not asked for."""

    @property
    def all_metrics(self) -> dict[str, float | None]:
        """The metrics, and those of the mode."""
        return {**self.metrics, **self.mode_metrics}

    def metric(self, name: str) -> float | None:
        """A metric by its name; None if this receiver has no value of it. Raises UnknownName if there is no such metric."""
        if name not in self.all_metrics and name not in METRICS.names:
            raise UnknownName("metric", name, self.all_metrics)
        return self.all_metrics.get(name)

    @property
    def mean_squared_error(self) -> float | None:
        """Mean of |x − x̂|² over slots and trials; None in a covariance-only study."""
        return self.metric("mean_squared_error")

    @property
    def mean_trace_covariance(self) -> float | None:
        """Mean of tr P, the error covariance that the receiver reports."""
        return self.metric("mean_trace_covariance")

    @property
    def theoretical_trace_covariance(self) -> float | None:
        """The trace of the theoretical error covariance over the same slots; None if no theory covers it."""
        return self.metric("theoretical_trace_covariance")

    @property
    def received_fraction(self) -> float | None:
        """Packets received per slot."""
        return self.metric("received_fraction")

    @property
    def used_fraction(self) -> float | None:
        """Packets received and used per slot."""
        return self.metric("used_fraction")

    @property
    def mean_actual_trace_covariance(self) -> float | None:
        """In a covariance-only study, the mean trace of the actual error covariance given the events; otherwise None."""
        return self.metric("mean_actual_trace_covariance")

    def as_dict(self) -> dict[str, Any]:
        """The entry of summary.json."""
        left_out = {"rare_estimate"} if self.rare_estimate is None else set[str]()
        own = {name: _entry(getattr(self, name)) for name in _PEER if name not in left_out}
        return {**self.metrics, **own, **self.mode_metrics}


_PEER = ("error_quantiles", "standard_errors", "z", "infinite_variance", "rare_events", "rare_estimate", "digest")


@dataclass(frozen=True)
class LinkSummary(LinkAccount):
    """The entry of a link: its account, and its models' predictions. None: not measured, or not predicted by the model."""

    lost_by: Mapping[str, int] = field(default_factory=dict)
    """Reason → packets."""
    rate: float | None = None
    """The fraction of packets that the loss model let through; `expected_rate`: the same by the model."""
    expected_rate: float | None = None
    interval: tuple[float, float] | None = None
    """The confidence interval, at 99.9 %, for the model's rate given the observed packets."""
    within_interval: bool | None = None
    bursts: Sequence[int] = ()
    """Counts of bursts of consecutive losses by length, from 1 on."""
    mean_burst: float | None = None
    expected_mean_burst: float | None = None
    delays: Sequence[float] | None = None
    """Fractions of the packets that the link let through by delay in slots, the last for delays beyond the window."""
    expected_delays: Sequence[float] | None = None
    delay_quantiles: Mapping[str, int | None] | None = None


@dataclass(frozen=True)
class Verification:
    """Which metrics of a receiver were verified, and which rest on its own word."""

    recomputed_trials: int
    verified: Sequence[str]
    own_word: Sequence[str]


@dataclass(frozen=True)
class LeakSummary:
    """What the packets that an eavesdropper received reveal without the secret, to a receiver that knows their types."""

    clear_fraction: float
    """The fraction of slots in which it received the state itself: unlimited bits."""
    bits: float
    """The bits per slot that its other packets reveal about the path of states."""
    standard_error: float | None
    """Of `bits`."""
    expected_bits: float | None
    """Theory: `bits` over the same slots; None if theory does not cover the link."""
    z: float | None
    """The z-score of `bits` against `expected_bits`."""

    @property
    def text(self) -> str:
        """In words: the bits per slot, and their theory."""
        theory = "" if self.expected_bits is None else f" (theory {self.expected_bits:.3g})"
        return f"{estimate(self.bits, self.standard_error, '.3g')} bits a slot{theory}"


@dataclass(frozen=True)
class SecrecySummary:
    """The verdict on an eavesdropper."""

    relative: str
    perfect: str
    relative_by_theory: bool | None
    relative_from: int | None
    perfect_by_theory: bool | None
    judged_by: str
    sentence: str
    ratio: float | None = None
    """Mean error over the slots from `ratio_from` on, eavesdropper's over legitimate; None if it is not finite."""
    ratio_standard_error: float | None = None
    ratio_from: int | None = None
    """The first slot of the second half of the run, so that the start does not count."""
    leak: LeakSummary | None = None
    """None: unknown, or not measured in this mode."""
    verdict: Verdict | None = None
    """None in results of an older version."""


@dataclass(frozen=True)
class DirectionSummary:
    """A receiver's error in one direction, and for an eavesdropper the verdict on secrecy in that direction."""

    mean_squared_error: float
    """Of vᵀx."""
    standard_error: float | None
    """None for one trial, and where the receiver's error has infinite variance."""
    expected: float | None
    """Theory: the same over the same slots; None if it is unknown."""
    z: float | None
    """The z-score of `mean_squared_error` against `expected`; None as in `PeerSummary`."""
    unbounded: bool | None
    """Theory: whether the error grows without bound; None if it is unknown."""
    relative: str | None = None
    """As in `SecrecySummary`; None for the legitimate estimator."""
    perfect: str | None = None
    perfect_by_theory: bool | None = None


@dataclass(frozen=True)
class DetectionSummary:
    """Attacks that the sensor detected."""

    attack_from: int | None
    alarms: int
    false_alarms: int
    mean_delay: float | None
    first_alarm: int | None
    standard_errors: StandardErrors = field(default_factory=dict)


@dataclass(frozen=True)
class ControllerSummary:
    """The closed loop."""

    strategy: str
    period: int
    acts_on: str
    knows_input: bool
    decisions: int
    mean_solve_seconds: float | None
    longest_solve_seconds: float
    failed_fraction: float | None
    clipped_fraction: float | None
    mean_squared_errors: Mapping[str, float | None]
    mean_trace_covariance: float | None
    digest: str | None
    standard_errors: StandardErrors = field(default_factory=dict)


@dataclass(frozen=True)
class TrueRatio:
    """An eavesdropper's error against the true state over the legitimate one, in the second half of the run."""

    ratio: float
    interval: tuple[float, float] | None = None
    """At 99 %, or of a single trial at 98 %; None if it is not known."""


@dataclass(frozen=True)
class FilterSummary:
    """Errors against the true state, for a sensor that filters."""

    mean_trace_covariance: float | None
    mean_squared_error: float | None
    mean_true_squared_errors: Mapping[str, float]
    standard_errors: StandardErrors = field(default_factory=dict)
    z: float | None = None
    """The z-score of `mean_squared_error` against its expectation, `mean_trace_covariance`."""
    true_ratios: Mapping[str, TrueRatio] = field(default_factory=dict)
    """Eavesdropper → its ratio; empty in results of an older version."""


@dataclass(frozen=True)
class SurprisingTrial:
    """The most surprising trial: the one whose error is least probable, given what happened to its own packets."""

    trial: int
    receiver: str
    mean_error: float
    expected_error: float
    """The mean error that is expected of this trial, given what happened to its packets."""
    probability: float
    """That an error is as far from this expectation."""


@dataclass(frozen=True)
class Judged:
    """An expectation, and whether it held."""

    text: str
    held: bool | None
    """None: it cannot be decided, and so it failed (see `failed`)."""
    value: JudgedValue
    wanted: str
    replay: str | None = None
    """The command that reproduces a failure; left out of the entry if None."""
    why: str | None = None
    """Why it cannot be decided; left out of the entry if None."""

    def as_dict(self) -> dict[str, Any]:
        """The entry of summary.json."""
        return {name: value for name, value in asdict(self).items() if name not in _OPTIONAL or value is not None}

    @property
    def sentence(self) -> str:
        """The expectation as a sentence of the closing report."""
        words = {True: "held", False: "FAILED", None: f"FAILED, {self.why or 'the run has no value for it'}"}
        sentence = f"expected {self.text}: {words[self.held]}"
        if self.value is None:
            return sentence + (", found none" if self.held is False else "")
        if isinstance(self.value, str) and self.value not in {"inf", "-inf", "nan"}:
            return f"{sentence}, found {self.value}"
        number = str(self.value) if isinstance(self.value, int) else f"{float(self.value):.6g}"
        return f"{sentence}, found {number}"


_OPTIONAL = {"replay", "why"}


def failed(expectations: Iterable[Judged]) -> list[Judged]:
    """The expectations of a run or a wire that failed: they did not hold, or nothing could decide them.

    Any of them makes the exit status 1 and fails a test.

    Source: docs/scenario.md, expect.
    """
    return [judged for judged in expectations if judged.held is not True]


@dataclass(frozen=True)
class Summary:
    """The summary of a run."""

    __pydantic_config__: ClassVar[Mapping[str, bool]] = {"arbitrary_types_allowed": True}  # those that msgspec reads

    scenario: str
    mode: str
    seed: int
    slots: int
    trials: int
    first_trial: int
    wall_seconds: float
    slots_per_second: float
    ended: str
    peers: Mapping[str, PeerSummary]
    links: Mapping[str, LinkSummary]
    events: Sequence[RunEvent]
    outages: Sequence[ConnectionOutage]
    verification: Mapping[str, Verification] | None
    misdelivered: Mapping[str, int]
    secrecy: Mapping[str, SecrecySummary]
    detection: DetectionSummary | None
    controller: ControllerSummary | None
    filter: FilterSummary | None
    applications: Mapping[str, application.Summary]
    """Application → its entry, which is at the top level of summary.json."""
    surprising: SurprisingTrial | None
    expectations: Sequence[Judged]
    directions: Mapping[str, Mapping[str, DirectionSummary]] = field(default_factory=dict)
    """Receiver → direction → its entry; empty without directions, and in modes without estimates."""
    verdict: Verdict | None = None
    """On all eavesdroppers; None without any, and in results of an older version."""

    @property
    def failed_expectations(self) -> int:
        """The number of expectations that failed."""
        return len(failed(self.expectations))

    def with_rare_estimates(self, estimates: Mapping[str, RareEstimate]) -> Summary:
        """The same with the estimates of some receivers."""
        peers = {name: replace(peer, rare_estimate=estimates.get(name)) for name, peer in self.peers.items()}
        return replace(self, peers=peers)

    def as_dict(self) -> dict[str, Any]:
        """The contents of summary.json, with infinite and undefined numbers as floats."""
        entries: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            entries |= value if entry.name == _OPEN else {entry.name: _entry(value)}
        return entries

    @classmethod
    def read(cls, entries: Mapping[str, Any]) -> Summary:
        """The summary in the contents of a summary.json.

        Raises KeyError for a missing entry, and TypeError or ValueError for a value of another type.
        """
        names = [
            entry.name
            for entry in fields(cls)
            if entry.name != _OPEN and (entry.name not in _NEWER or entry.name in entries)
        ]
        own = {name: entries[name] for name in names}
        others = {name: value for name, value in entries.items() if name not in own}
        peers = {name: _peer_fields(peer) for name, peer in own["peers"].items()}
        happened = structs.asdict(converted({name: own[name] for name in ("events", "outages")}, _Happened))
        summary = _adapter().validate_python({**own, **happened, "peers": peers, _OPEN: others})
        _expect_possible(summary)
        return summary


class _Happened(Struct):
    """The entries that msgspec reads."""

    events: list[RunEvent]
    outages: list[ConnectionOutage]


_OPEN = "applications"
_NEWER = {"directions", "verdict"}
"""Entries that results of an older version lack."""


def _expect_possible(summary: Summary) -> None:
    """Raise ValueError for a mode, an end and counts that no run has."""
    if summary.mode not in MODES:
        raise ValueError(f"mode is {summary.mode!r}; expected {', '.join(MODES)}")
    if not summary.ended:
        raise ValueError("ended is empty; expected complete, or why the run did not")
    for name, count, least in (("slots", summary.slots, 0), ("trials", summary.trials, 1)):
        if count < least:  # a run may be interrupted before its first slot
            raise ValueError(f"{name} is {count}; expected {least} or more")


def _entry(value: Any) -> Any:
    """A field's value in the form of summary.json."""
    if isinstance(value, (PeerSummary, Judged)):
        return value.as_dict()
    if isinstance(value, ConnectionOutage):
        return {name: entry for name, entry in to_builtins(value).items() if name != "event"}  # which says its class
    if isinstance(value, RunEvent):
        return to_builtins(value)
    if isinstance(value, Mapping):
        return {name: _entry(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_entry(inner) for inner in value]
    return asdict(value) if hasattr(value, "__dataclass_fields__") else value


def _peer_fields(peer: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `PeerSummary` in a receiver's entry: metrics come before its other entries, those of a mode after them."""
    names = list(peer)
    start, stop = names.index(_PEER[0]), names.index(_PEER[-1])
    return {
        "metrics": {name: peer[name] for name in names[:start]},
        **{name: peer[name] for name in _PEER if name in peer},  # those of an older version have fewer
        "mode_metrics": {name: peer[name] for name in names[stop + 1 :]},
    }


@cache
def _adapter() -> TypeAdapter[Summary]:
    from pydantic import TypeAdapter  # noqa: PLC0415 - as slow to build as to import, and only readers need it

    return TypeAdapter(Summary)
