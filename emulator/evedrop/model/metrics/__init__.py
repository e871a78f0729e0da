"""The metrics of receivers, by their name in the summary. To add one, write a class and add it to `_BUILT_IN`.

An installed package adds one with an entry point in the group `evedrop.metrics`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from evedrop.errors import NotRegistered
from evedrop.model.metrics.built_in import (
    MeanActualTraceCovariance,
    MeanSquaredError,
    MeanTraceCovariance,
    ReceivedFraction,
    TheoreticalTraceCovariance,
    UsedFraction,
)
from evedrop.model.metrics.metric import Metric, MetricColumn
from evedrop.model.registry import Registry
from evedrop.names import LEGITIMATE

_BUILT_IN: Mapping[str, type[Metric]] = {
    "mean_squared_error": MeanSquaredError,
    "mean_trace_covariance": MeanTraceCovariance,
    "theoretical_trace_covariance": TheoreticalTraceCovariance,
    "received_fraction": ReceivedFraction,
    "used_fraction": UsedFraction,
    "mean_actual_trace_covariance": MeanActualTraceCovariance,
}

METRICS: Registry[Metric] = Registry(
    "metric",
    Metric,  # type: ignore[type-abstract]
    "evedrop.metrics",
    _BUILT_IN,
)
"""Name in the summary → metric."""

_TAKEN = ("error_quantiles", "standard_errors", "z", "infinite_variance", "rare_events", "rare_estimate", "digest")
"""The other entries of a receiver in the summary, which no metric can be named after."""


def metric(name: str) -> type[Metric]:
    """A metric by its name. Raises NotRegistered if no metric has this name, its name cannot be used, or it cannot be loaded."""
    if name in _TAKEN or not name.isidentifier():
        wanted = "; expected a name of letters, digits and _ that no other entry of a receiver in the summary has"
        raise NotRegistered(name, wanted)
    return METRICS[name]


def all_metrics() -> dict[str, type[Metric]]:
    """Name → metric, for all that can be loaded: the built-in ones in their order, then those of installed packages."""
    left_out = unloadable_metrics()
    return {name: metric(name) for name in _names() if name not in left_out}


def unloadable_metrics() -> dict[str, str]:
    """Name → why it cannot be loaded, in words that follow the name, for metrics of installed packages."""
    reasons = {}
    for name in _names():
        try:
            metric(name)
        except NotRegistered as error:
            reasons[name] = error.why
    return reasons


def metrics_of(receiver: str) -> dict[str, type[Metric]]:
    """Name → metric, for all that the receiver of this name has."""
    return {name: metric for name, metric in all_metrics().items() if metric.of == "receiver" or receiver != LEGITIMATE}


def estimated_metrics() -> dict[str, type[Metric]]:
    """Name → metric, for all that a run estimates: all but those of theory."""
    return {name: metric for name, metric in all_metrics().items() if metric.rests_on != "theory"}


def expectable_metrics() -> dict[str, type[Metric]]:
    """Name → metric, for all that an expectation can name."""
    return {name: metric for name, metric in all_metrics().items() if metric.only_in_mode is None}


def columns(where: Literal["column", "sweep_column"], mode: str | None = None) -> dict[MetricColumn, list[str]]:
    """Column → the names of the metrics that share it, in order of columns.

    where: the closing table, or the printed table of a sweep; mode: leave out metrics that a run in this mode does not have.
    """
    names_of: dict[MetricColumn, list[str]] = {}
    for name, kind in all_metrics().items():
        column: MetricColumn | None = getattr(kind, where)
        there = mode is None or (mode != kind.not_in_mode and kind.only_in_mode in {None, mode})
        if column is not None and there:
            names_of.setdefault(column, []).append(name)
    return dict(sorted(names_of.items(), key=lambda item: item[0].place))


def shown_metric(row: Mapping[str, Any], names: Sequence[str]) -> float | None:
    """The value that a column or a curve shows: the first of these metrics that a row has; None if it has none of them."""
    return next((float(row[name]) for name in names if row.get(name) is not None), None)


def error_column(metric: str) -> str:
    """The column of a sweep's table that has the standard error of a metric."""
    return f"{metric}_standard_error"


def z_column(metric: str) -> str:
    """The column of a sweep's table that has the z of a metric."""
    return f"{metric}_z"


def _names() -> list[str]:
    return list(dict.fromkeys([*METRICS, *METRICS.names]))
