"""The figures of receivers, by their name in the summary. To add one, write a class and add it to `_BUILT_IN`.

An installed package adds one with an entry point in the group `evedrop.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from evedrop.errors import NotRegistered
from evedrop.model.figures.covariances import ExpectedTraceCovariance, MeanTraceCovariance
from evedrop.model.figures.errors import MeanActualTraceCovariance, MeanSquaredError
from evedrop.model.figures.figure import Figure, FigureColumn
from evedrop.model.figures.packets import ReceivedFraction, UsedFraction
from evedrop.model.registry import Registry
from evedrop.names import LEGITIMATE

_BUILT_IN: Mapping[str, type[Figure]] = {
    "mean_squared_error": MeanSquaredError,
    "mean_trace_covariance": MeanTraceCovariance,
    "expected_trace_covariance": ExpectedTraceCovariance,
    "received_fraction": ReceivedFraction,
    "used_fraction": UsedFraction,
    "mean_actual_trace_covariance": MeanActualTraceCovariance,
}

FIGURES: Registry[Figure] = Registry(
    "figure",
    Figure,  # type: ignore[type-abstract]
    "evedrop.figures",
    _BUILT_IN,
)
"""Name in the summary → figure."""

_TAKEN = ("error_quantiles", "standard_errors", "z", "infinite_variance", "rare_events", "rare_estimate", "digest")
"""The other entries of a receiver in the summary, which no figure can be named after."""


def figure(name: str) -> type[Figure]:
    """A figure by its name. Raises NotRegistered if no figure has this name, its name cannot be used, or it cannot be loaded."""
    if name in _TAKEN or not name.isidentifier():
        wanted = "; expected a name of letters, digits and _ that no other entry of a receiver in the summary has"
        raise NotRegistered(name, wanted)
    return FIGURES[name]


def all_figures() -> dict[str, type[Figure]]:
    """Name → figure, for all that can be loaded: the built-in ones in their order, then those of installed packages."""
    left_out = unloadable_figures()
    return {name: figure(name) for name in _names() if name not in left_out}


def unloadable_figures() -> dict[str, str]:
    """Name → why it cannot be loaded, in words that follow the name, for figures of installed packages."""
    found = {}
    for name in _names():
        try:
            figure(name)
        except NotRegistered as error:
            found[name] = error.why
    return found


def figures_of(receiver: str) -> dict[str, type[Figure]]:
    """Name → figure, for all that the receiver of this name has."""
    return {name: one for name, one in all_figures().items() if one.of == "receiver" or receiver != LEGITIMATE}


def estimated_figures() -> dict[str, type[Figure]]:
    """Name → figure, for all that a run estimates: all but those of theory."""
    return {name: one for name, one in all_figures().items() if one.rests_on != "theory"}


def expectable_figures() -> dict[str, type[Figure]]:
    """Name → figure, for all that an expectation can name."""
    return {name: one for name, one in all_figures().items() if one.only_in_mode is None}


def columns(where: Literal["column", "sweep_column"], mode: str | None = None) -> dict[FigureColumn, list[str]]:
    """Column → the names of the figures that share it, in order of columns.

    where: the closing table, or the printed table of a sweep; mode: leave out figures that a run in this mode does not have.
    """
    found: dict[FigureColumn, list[str]] = {}
    for name, one in all_figures().items():
        column: FigureColumn | None = getattr(one, where)
        there = mode is None or (mode != one.not_in_mode and one.only_in_mode in {None, mode})
        if column is not None and there:
            found.setdefault(column, []).append(name)
    return dict(sorted(found.items(), key=lambda item: item[0].place))


def shown_figure(row: Mapping[str, Any], names: Sequence[str]) -> float | None:
    """The value that a column or a curve shows: the first of these figures that a row has; None if it has none of them."""
    return next((float(row[name]) for name in names if row.get(name) is not None), None)


def error_column(figure: str) -> str:
    """The column of a sweep's table that has the standard error of a figure."""
    return f"{figure}_standard_error"


def z_column(figure: str) -> str:
    """The column of a sweep's table that has the z of a figure."""
    return f"{figure}_z"


def _names() -> list[str]:
    return list(dict.fromkeys([*FIGURES, *FIGURES.names]))
