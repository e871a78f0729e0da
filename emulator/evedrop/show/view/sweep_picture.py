"""The plot of a sweep: every receiver's error against the first entry, in a panel for each combination of the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from evedrop.model.metrics import all_metrics, error_column, shown_metric
from evedrop.show.view.figure_style import drawing, panels
from evedrop.show.view.palette import RECEIVERS, hexadecimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from evedrop.show.view.shown_figure import ShownFigure

_COLOURS = tuple(hexadecimal(one) for one in RECEIVERS)
_MARKS = "osD^vPX*"
_MOST_PANELS = 6


def draw(path: Path, table: pa.Table, keys: Sequence[str]) -> None:
    """Draw the table of a sweep over these keys as `path`.png and `path`.pdf: simulated errors as marks, theory as lines.

    Bars at the marks are standard errors.
    """
    rows = table.to_pylist()
    count = len(_others(rows, keys))
    with panels(path, count, *_size(count)) as axes:
        _draw_on(axes, rows, keys)


def sweep_figure(table: pa.Table, keys: Sequence[str]) -> ShownFigure:
    """The plot of a sweep as a figure."""
    rows = table.to_pylist()
    count = len(_others(rows, keys))
    with drawing(*_size(count)) as figure:
        _draw_on(list(figure.subplots(1, count, squeeze=False)[0]), rows, keys)
    return figure


def _size(count: int) -> tuple[float, float]:
    """Width and height of this number of panels, in inches."""
    return 1.2 + 4.2 * count, 3.9


def _others(rows: list[dict[str, Any]], keys: Sequence[str]) -> list[tuple[Any, ...]]:
    """The combinations of values of all entries but the first, a panel for each."""
    return list(dict.fromkeys(tuple(row[key] for key in keys[1:]) for row in rows))[:_MOST_PANELS]


def _draw_on(axes: list[Axes], rows: list[dict[str, Any]], keys: Sequence[str]) -> None:
    marks, lines = (
        [name for name, scheme in all_metrics().items() if scheme.sweep_picture == way] for way in ("marks", "lines")
    )
    peers = list(dict.fromkeys(row["peer"] for row in rows))
    for scheme, values in zip(axes, _others(rows, keys), strict=True):
        for peer, colour, mark in zip(peers, _COLOURS * 10, _MARKS * 9, strict=False):
            mine = [row for row in rows if row["peer"] == peer and tuple(row[key] for key in keys[1:]) == values]
            x = _positions([row[keys[0]] for row in mine])
            theory = [_height(row, lines) for row in mine]
            numbers = all(isinstance(row[keys[0]], (int, float)) for row in mine)
            scheme.plot(x, theory, "-" if numbers else "_", color=colour, linewidth=1.2, markersize=26)
            scheme.errorbar(
                x,
                [_height(row, marks) for row in mine],
                [_height(row, [error_column(name) for name in marks]) for row in mine],
                fmt=mark,
                color=colour,
                markerfacecolor="white",
                elinewidth=1.0,
                capsize=2.5,
                label=peer,
            )
            if not numbers:
                scheme.set_xticks(x, [str(row[keys[0]]) for row in mine])
                scheme.set_xlim(-0.5, len(x) - 0.5)
        scheme.set_yscale("log")
        scheme.set_xlabel(keys[0])
        scheme.set_title(", ".join(f"{key} = {value}" for key, value in zip(keys[1:], values, strict=True)))
    limits = [limit for scheme in axes for limit in scheme.get_ylim()]
    for scheme in axes:
        scheme.set_ylim(min(limits), max(limits))
    axes[0].set_ylabel("mean error ± standard error (lines: theory)")
    axes[0].legend()


def _height(row: dict[str, Any], metrics: list[str]) -> float:
    value = shown_metric(row, metrics)
    return math.nan if value is None else value


def _positions(values: list[Any]) -> list[float]:
    """Places on the axis: numbers as they are; other values side by side."""
    if all(isinstance(value, (int, float)) for value in values):
        return [float(value) for value in values]
    return [float(i) for i in range(len(values))]
