"""`[[expect]]` of a wire file: a condition on what a link delivered, how long it held messages back, and its longest gaps.

Source: docs/wire.md, expectations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from evedrop.model.checks import as_toml
from evedrop.scenario.table import Found, Table, expected
from evedrop.scenario.words import listed
from evedrop.system.hints import near
from evedrop.wire.metrics import WIRE_METRICS
from evedrop.wire.units import in_seconds

_BOUNDS = ("below", "above")


def _bound(value: Any) -> Any:
    seconds = in_seconds(value) if isinstance(value, str) else None
    if isinstance(value, str) and seconds is None:
        raise expected('a number, or a length of time such as "20 ms"')
    return value if seconds is None else seconds


def _metric(text: str) -> str:
    _, dot, metric = text.rpartition(".")
    if not dot or metric not in WIRE_METRICS:
        names = [f"LINK.{one}" for one in WIRE_METRICS]
        raise expected(listed(names), near(metric, WIRE_METRICS))
    return text


Bound = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False), BeforeValidator(_bound)]


class WireExpectTable(Table):
    """`[[expect]]` of a wire file: a metric of a link with its bounds, or a link whose losses must agree with its model."""

    metric: Annotated[
        str | None, AfterValidator(lambda text: text and _metric(text)), Field(examples=["scan.delivery"])
    ] = None
    below: Annotated[Bound | None, Field(examples=[0.9])] = None
    above: Annotated[Bound | None, Field(examples=[0.5])] = None
    quantile: Annotated[float | None, Field(strict=True, gt=0.0, lt=1.0, examples=[0.99])] = None
    link: Annotated[str | None, Field(strict=True, examples=["scan"])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes unless there is a metric with a bound, or a link alone."""
        given = [name for name, value in table.items() if value is not None]
        if "link" in given:
            others = [name for name in given if name in {"metric", "quantile", *_BOUNDS}]
            return [
                (name, 'is set, but a table with link has no other entries; expected link = "scan" alone')
                for name in others
            ]
        if "metric" not in given:
            return [("metric", 'is missing; expected metric = "scan.delivery" with below or above, or link = "scan"')]
        found = []
        if not set(given) & set(_BOUNDS):
            found.append(("below", "is missing, and so is above; add one of them, or both"))
        metric = WIRE_METRICS.get(str(table["metric"]).rpartition(".")[2])
        if (metric is not None and metric.has_quantile) == ("quantile" not in given):
            names = [one.name for one in WIRE_METRICS.values() if one.has_quantile]
            said = (
                f"is missing; a {listed(names)} needs one"
                if "quantile" not in given
                else f"is set, but only a {listed(names)} has quantiles"
            )
            found.append(
                ("quantile", f"{said}; expected quantile = 0.99 with {listed([f'LINK.{one}' for one in names])}")
            )
        return found

    @property
    def subject(self) -> str:
        """The name of the link."""
        return self.link if self.link is not None else str(self.metric).rpartition(".")[0]

    @property
    def wanted(self) -> str:
        """The value that is expected."""
        if self.link is not None:
            return "within the 99 % bounds of its model"
        bounds = [(name, getattr(self, name)) for name in _BOUNDS]
        return " and ".join(f"{name} {value:.10g}" for name, value in bounds if value is not None)

    @property
    def text(self) -> str:
        """The expectation as a part of a sentence."""
        if self.link is not None:
            return f"link {self.link} {self.wanted}"
        quantile = "" if self.quantile is None else f"{self.quantile:.10g} quantile of "
        return f"{quantile}{self.metric} {self.wanted}"

    def holds(self, found: float) -> bool:
        """Whether a metric meets the expectation."""
        return (self.below is None or found < self.below) and (self.above is None or found > self.above)


def expectation_mistakes(expectations: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Iterator[str]:
    """Mistakes in the names of links, of tables that may be malformed."""
    for i, table in enumerate(expectations):
        for entry in ("metric", "link"):
            text = table.get(entry)
            link = text.rpartition(".")[0] if isinstance(text, str) and entry == "metric" else text
            if isinstance(link, str) and link and link not in names:
                choice = f"expected a metric or the name of {listed(names)}" if names else "the file has no link"
                yield f"expect.{i}.{entry}: is {as_toml(text)}, but there is no link {link}; {choice}{near(link, names)}"
