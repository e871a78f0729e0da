"""`[[expect]]`: a condition that a run must meet: on a metric, on a link, on secrecy, or on when a receiver is synchronised.

Source: docs/scenario.md, expect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import AfterValidator, Field

from evedrop.model.links.loss_model import REASONS
from evedrop.model.metrics import expectable_metrics, metrics_of, unloadable_metrics
from evedrop.model.metrics.built_in import LINK_METRICS
from evedrop.scenario.application import APPLICATIONS, Application
from evedrop.scenario.table import Mistake, Number, Table, expected, one_of
from evedrop.scenario.words import as_toml, listed
from evedrop.system.hints import near

SECRECY = ("relative", "perfect")

LINKS, DIRECTIONS = "links", "directions"
_COMPARISONS = ("below", "above", "near", "within", "within_relative")
_ENTRIES: Mapping[str, tuple[str, ...]] = {
    "metric": (*_COMPARISONS, "slots", "quantile"),
    "link": (),
    "secrecy": ("against", "direction"),
    "synchronised": ("by", "since"),
}
"""The subjects an expectation may have → the entries that go with each."""


def _range(slots: list[int]) -> list[int]:
    if len(slots) != 2 or not 0 <= slots[0] < slots[1]:
        raise expected("two slots [from, to], 0 ≤ from < to")
    return slots


def _quantile(value: float) -> float:
    if not 0.0 < value < 1.0:
        raise expected("a number between 0 and 1, both excluded")
    return value


Secrecy = Annotated[str, AfterValidator(one_of(SECRECY))]
Range = Annotated[list[Annotated[int, Field(strict=True)]], AfterValidator(_range)]
Quantile = Annotated[float, Field(strict=True), AfterValidator(_quantile)]
Distance = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Slot = Annotated[int, Field(strict=True, ge=0)]


class ExpectTable(Table):
    """`[[expect]]`: one of `metric`, `link`, `secrecy` and `synchronised`, with the entries that go with it."""

    metric: Annotated[str | None, Field(examples=["legitimate.mean_squared_error"])] = None
    """The metric, as RECEIVER.METRIC, links.RECEIVER.METRIC, directions.RECEIVER.NAME or a metric of an application."""
    below: Annotated[Number | None, Field(examples=[0.01])] = None
    """The metric must be less."""
    above: Annotated[Number | None, Field(examples=[0.01])] = None
    """The metric must be greater."""
    near: Annotated[Number | None, Field(examples=[0.01])] = None
    """The metric must be close to this number; `within` or `within_relative` says how close."""
    within: Annotated[Distance | None, Field(examples=[0.002])] = None
    """The largest distance from `near`."""
    within_relative: Annotated[Distance | None, Field(examples=[0.1])] = None
    """The largest distance as a fraction of `near`: 0.1 is ten per cent."""
    slots: Annotated[Range | None, Field(examples=[[100, 200]])] = None
    """The metric only over the slots from ≤ k < to."""
    quantile: Annotated[Quantile | None, Field(examples=[0.9])] = None
    """The quantile over trials of a trial's mean, in place of the mean over trials."""
    link: Annotated[str | None, Field(examples=["legitimate"])] = None
    """The receiver whose link must deliver as often as its model says, within a confidence interval."""
    secrecy: Annotated[Secrecy | None, Field(examples=["relative"])] = None
    """The kind of secrecy that theory must promise and the run must show."""
    against: Annotated[str | None, Field(examples=["smart"])] = None
    """The eavesdropper against which there must be secrecy."""
    direction: Annotated[str | None, Field(examples=["position"])] = None
    """One of the process's `directions`, in which there must be secrecy."""
    synchronised: Annotated[str | None, Field(examples=["legitimate"])] = None
    """The receiver that must have used a packet as the state, in every trial."""
    by: Annotated[Slot | None, Field(examples=[40])] = None
    """The last slot by which it must have done so."""
    since: Annotated[Slot | None, Field(examples=[0])] = None
    """The first slot that counts; by default that of the receiver's last event up to slot `by`, or 0."""

    def mistakes(self) -> Iterable[Mistake]:
        """Mistakes unless the table has exactly one subject, all the entries that this subject needs, and no others."""
        given = [name for name, value in self if value is not None]
        kinds = [kind for kind in _ENTRIES if kind in given]
        if not kinds:
            meant = [kind for kind, entries in _ENTRIES.items() if any(name in given for name in entries)]
            kind = meant[0] if meant else "metric"
            others = ", or one of " + ", ".join(name for name in _ENTRIES if name != kind) if not meant else ""
            return [(kind, f"is missing; expected {kind} = {self._example(kind)}{others}")]
        if len(kinds) > 1:
            one_each = f"expected one of {', '.join(_ENTRIES)} in a table"
            return [(kind, f"is given together with {kinds[0]}; {one_each}") for kind in kinds[1:]]
        (kind,) = kinds
        mistakes = [
            (name, f"is set, but {kind} has no such entry; remove the line")
            for other, entries in _ENTRIES.items()
            for name in entries
            if other != kind and name in given
        ]
        if self.metric is not None:
            mistakes += self._bound_mistakes()
            mistakes += self._metric_mistakes(self.metric)
        if kind == "secrecy" and self.against is None:
            mistakes.append(("against", "is missing; expected the name of an eavesdropper"))
        if kind == "synchronised" and self.by is None:
            mistakes.append(
                ("by", "is missing; expected the last slot by which it must be synchronised, such as by = 40")
            )
        elif kind == "synchronised" and self.by is not None and self.since is not None and self.by < self.since:
            mistakes.append(("by", f"is {self.by}, before since, which is {self.since}; expected since ≤ by"))
        return mistakes

    def _bound_mistakes(self) -> Iterator[Mistake]:
        """Mistakes unless there is a bound to compare with."""
        distances = [name for name in ("within", "within_relative") if getattr(self, name) is not None]
        if self.near is None and distances:
            yield distances[0], "is set without near; expected near = 0.01 as well"
        elif self.near is None and self.below is None and self.above is None:
            yield "below", "is missing, and so is above; add below, above or near, such as below = 0.01"
        elif self.near is not None and not distances:
            yield "within", "is missing; expected within = 0.002, or within_relative = 0.1, with near"
        elif len(distances) > 1:
            yield "within_relative", "is given together with within; expected one of them"
        elif self.near == 0 and distances == ["within_relative"]:
            yield "within_relative", "is set, but any fraction of near = 0 is 0; expected within"
        if self.below is not None and self.above is not None and not self.above < self.below:
            yield "above", f"is {as_toml(self.above)}, and below is {as_toml(self.below)}; expected above < below"

    def _metric_mistakes(self, metric: str) -> Iterator[Mistake]:
        """Slots or a quantile for a metric that does not allow them."""
        link = link_metric(metric)
        for name in ("slots", "quantile"):
            if direction_metric(metric) is not None and getattr(self, name) is not None:
                yield name, "is set, but the error in a direction is the mean of the whole run; remove the line"
            if link is not None and getattr(self, name) is not None:
                instead = f"expected none, or the metric {link[0]}.received_fraction"
                yield name, f"is set, but a link's account is of the whole run; {instead}"
        metrics = expectable_metrics()
        of_receiver = metrics.get(metric.rpartition(".")[2])
        if link is None and self.quantile is not None and of_receiver is not None and not of_receiver.by_trial:
            all_trials = listed([name for name, kind in metrics.items() if kind.by_trial])
            instead = f"expected a metric that every trial has: {all_trials}"
            yield "quantile", f"is set, but {metric} is not known trial by trial; {instead}"

    @property
    def kind(self) -> str:
        """Its subject: `metric`, `link`, `secrecy` or `synchronised`."""
        return next(kind for kind in _ENTRIES if getattr(self, kind) is not None)

    @property
    def wanted(self) -> str:
        """The value or outcome that is expected."""
        match self.kind:
            case "link":
                return "within its confidence interval"
            case "secrecy":
                both = self.direction is None or self.secrecy == "perfect"
                return "promised by theory and shown by the run" if both else "shown by the run"
            case "synchronised":
                return f"by slot {self.by}" + ("" if self.since is None else f", since slot {self.since}")
        bounds = [f"{name} {value:.10g}" for name in ("below", "above") if (value := getattr(self, name)) is not None]
        if self.near is not None:
            around = f"{self.within:.10g}" if self.within is not None else f"{self.within_relative:.10g} of it"
            bounds.append(f"near {self.near:.10g} within {around}")
        return " and ".join(bounds)

    @property
    def text(self) -> str:
        """The expectation as a sentence."""
        of_direction = "" if self.direction is None else f" of {self.direction}"
        subject = {
            "metric": self.metric,
            "link": f"link {self.link}",
            "secrecy": f"{self.secrecy} secrecy{of_direction} against {self.against}",
            "synchronised": f"{self.synchronised} synchronised",
        }[self.kind]
        if self.quantile is not None:
            subject = f"{self.quantile:.10g} quantile of {subject}"
        if self.slots is not None:
            subject = f"{subject} over slots {self.slots[0]} to {self.slots[1] - 1}"
        return f"{subject} {self.wanted}"

    def holds(self, value: float) -> bool:
        """Whether a metric meets the expectation."""
        if (self.below is not None and not value < self.below) or (self.above is not None and not value > self.above):
            return False
        if self.near is None:
            return True
        relative = self.within_relative or 0.0
        return abs(value - self.near) <= (self.within if self.within is not None else relative * abs(self.near))


def link_metric(metric: str) -> tuple[str, tuple[str, ...]] | None:
    """The receiver of a link's metric, and the metric's path in the account of the link; None for a receiver's own metric."""
    parts = metric.split(".")
    return (parts[1], tuple(parts[2:])) if parts[0] == LINKS and len(parts) > 2 else None


def direction_metric(metric: str) -> tuple[str, str] | None:
    """The receiver and the direction of a direction's metric; None for any other."""
    parts = metric.split(".")
    return (parts[1], parts[2]) if parts[0] == DIRECTIONS and len(parts) == 3 else None


@dataclass(frozen=True)
class Around:
    """The parts of a scenario that expectations refer to."""

    receivers: Sequence[str]
    """The legitimate estimator first."""
    slots: int
    trials: int
    no_theory: Callable[[str], str | None]
    """Why no theory covers a receiver; None if one does."""
    applications: Mapping[str, type[Application]] = field(default_factory=dict)
    """Those whose tables the scenario has."""
    directions: Sequence[str] = ()
    """Names of the process's directions."""

    def mistakes(self, expectation: ExpectTable) -> list[Mistake]:
        """Unknown receivers and metrics, slots beyond the run, and quantiles of too few trials."""
        mistakes: list[Mistake] = []
        direction = None if expectation.metric is None else direction_metric(expectation.metric)
        if expectation.metric is not None and (direction is None or direction[0] not in self.receivers):
            mistakes += self._metric_mistakes(expectation.metric)
            application = expectation.metric.partition(".")[0]
            if application in self.applications:
                mean = (
                    f"is set, but the {application}'s metrics are means over trials of the whole run; remove the line"
                )
                mistakes += [(name, mean) for name in ("slots", "quantile") if getattr(expectation, name) is not None]
        names = {"link": self.receivers, "synchronised": self.receivers, "against": self.receivers[1:]}
        for entry, names_ in names.items():
            name = getattr(expectation, entry)
            if name is not None and name not in names_:
                choice = f"expected {listed(names_)}" if names_ else "there is no eavesdropper; add one"
                mistakes.append((entry, f"is {as_toml(name)}; {choice}{near(name, names_)}"))
        mistakes += self._direction_mistakes(expectation)
        return mistakes + self._slot_mistakes(expectation) + self._quantile_mistakes(expectation.quantile)

    def _unknown_direction(self, name: str) -> str | None:
        """What to do if the process has no such direction; None if it has."""
        if name in self.directions:
            return None
        if not self.directions:
            return f"there are no directions; expected process.directions = {{ {name} = [1.0, 0.0] }}, a number for each state"
        return f"expected {listed(self.directions)}{near(name, self.directions)}"

    def _direction_mistakes(self, expectation: ExpectTable) -> list[Mistake]:
        """Directions that the process does not have, as the entry `direction` or in a metric."""
        named = [("direction", expectation.direction, "")]
        metric = None if expectation.metric is None else direction_metric(expectation.metric)
        if metric is not None and metric[0] in self.receivers:
            named.append(("metric", metric[1], f"{DIRECTIONS}.{metric[0]}."))
        return [
            (entry, f"is {as_toml(before + name)}; {sentence}")
            for entry, name, before in named
            if name is not None and (sentence := self._unknown_direction(name)) is not None
        ]

    def _metric_mistakes(self, metric: str) -> list[Mistake]:
        link = link_metric(metric)
        metrics = expectable_metrics()
        own = [f"{receiver}.{name}" for receiver in self.receivers for name in metrics_of(receiver) if name in metrics]
        links = [f"{LINKS}.{receiver}.{name}" for receiver in self.receivers for name in LINK_METRICS]
        reasons = [f"{LINKS}.{receiver}.lost_by.{reason}" for receiver in self.receivers for reason in REASONS]
        first = metric.partition(".")[0]
        if first not in self.receivers and first in APPLICATIONS:
            return self._application_mistakes(metric, first, APPLICATIONS[first])
        name = metric.rpartition(".")[2]
        if metric not in [*own, *links, *reasons]:
            broken = unloadable_metrics().get(name)
            if broken is not None:
                return [("metric", f"is {as_toml(metric)}{broken}")]
            names = f"RECEIVER ({', '.join(self.receivers)}).METRIC ({', '.join(metrics)})"
            of_links = f"{LINKS}.RECEIVER.METRIC ({', '.join(LINK_METRICS)}, lost_by.REASON)"
            hint = near(metric, reasons if ".lost_by." in metric else [*own, *links])
            return [("metric", f"is {as_toml(metric)}; expected {names} or {of_links}{hint}")]
        why = self.no_theory(first) if link is None and metrics[name].needs_theory else None
        if why is not None:
            return [("metric", f"is {as_toml(metric)}, but {why}; expected another metric")]
        return []

    def _application_mistakes(self, metric: str, name: str, application: type[Application]) -> list[Mistake]:
        own, of_receivers = application.metrics, application.receiver_metrics
        if name not in self.applications:
            wanted = f"expected a table [{name}], or another metric"
            return [("metric", f"is {as_toml(metric)}, but there is no {name}; {wanted}")]
        metrics = [f"{name}.{name_}" for name_ in own]
        metrics += [f"{name}.{receiver}.{name_}" for receiver in self.receivers for name_ in of_receivers]
        if metric in metrics:
            return []
        choice = [f"{name}.METRIC ({', '.join(own)})"] if own else []
        choice += [f"{name}.RECEIVER.METRIC ({', '.join(of_receivers)})"] if of_receivers else []
        return [("metric", f"is {as_toml(metric)}; expected {' or '.join(choice)}{near(metric, metrics)}")]

    def _slot_mistakes(self, expectation: ExpectTable) -> list[Mistake]:
        mistakes: list[Mistake] = []
        span = expectation.slots
        if span is not None and span[1] > self.slots:
            mistakes.append(("slots", f"is {as_toml(span)}; expected from < to ≤ slots, which is {self.slots}"))
        for name, slot in (("by", expectation.by), ("since", expectation.since)):
            if slot is not None and slot >= self.slots:
                mistakes.append((name, f"is {slot}; expected a slot of the run, 0 to {self.slots - 1}"))
        return mistakes

    def _quantile_mistakes(self, quantile: float | None) -> list[Mistake]:
        if quantile is None:
            return []
        # At least one trial is expected beyond the quantile. The tolerance is for rounding: 1/q is seldom exact in binary.
        least = math.ceil(1.0 / min(quantile, 1.0 - quantile) - 1e-9)
        if self.trials >= least:
            return []
        return [("quantile", f"is {quantile:g} of {self.trials} trials; expected trials = {least} or more")]
