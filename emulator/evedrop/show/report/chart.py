"""Charts with a logarithmic axis for the page, and the means of neighbours that a chart of a long run draws.

matplotlib draws them as SVG that takes its inks and its font from the page. Long rows of numbers are taken piece by piece, in a
few groups of neighbours, so that memory does not grow with their length.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import StringIO
from typing import TYPE_CHECKING, Any, final

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.show.report.page import made, printable
from evedrop.show.view.error_floor import ErrorAxis
from evedrop.show.view.figure_style import drawing
from evedrop.show.view.label_places import end_of, label_places

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class _Groups:
    """Divides `count` places into at most `most` groups of neighbours, as equal as possible."""

    def __init__(self, count: int, most: int) -> None:
        self.groups = min(count, most)
        self.taken = 0
        """How many places have been taken, from the first one on."""
        self._edges = np.linspace(0, count, self.groups + 1).astype(np.int64)

    def _next(self, count: int) -> NDArray[np.int64]:
        """The groups of the next places, (count,)."""
        places = np.arange(self.taken, self.taken + count)
        self.taken += count
        return np.asarray(np.searchsorted(self._edges, places, side="right") - 1, np.int64)


@final
class GroupMeans(_Groups):
    """The mean of each group of some functions of the place; not a number where one of its values is not."""

    def __init__(self, count: int, most: int, functions: int) -> None:
        super().__init__(count, most)
        self._sums = np.zeros((functions, self.groups))

    def add(self, values: Floats) -> None:
        """The values at the next c places, (functions, c)."""
        groups = self._next(values.shape[1])
        with np.errstate(over="ignore", invalid="ignore"):
            self._sums += np.stack([np.bincount(groups, row, self.groups) for row in values])

    @property
    def means(self) -> Floats:
        """(functions, groups)."""
        return np.asarray(self._sums / np.diff(self._edges), np.float64)


@final
class GroupCounts(_Groups):
    """How often each code occurs in each group."""

    def __init__(self, count: int, most: int, kinds: int) -> None:
        """kinds: codes are 0 to kinds − 1."""
        super().__init__(count, most)
        self._counts = np.zeros((self.groups, kinds), np.int64)

    def add(self, codes: Codes) -> None:
        """The codes at the next places, (c,)."""
        kinds = self._counts.shape[1]
        cells = self._next(len(codes)) * kinds + codes
        self._counts += np.bincount(cells, minlength=self._counts.size).reshape(self._counts.shape)

    @property
    def fractions(self) -> list[float]:
        """The fraction of each code among all codes so far; there must be at least one."""
        return [int(total) / self.taken for total in self._counts.sum(0)]

    @property
    def commonest(self) -> Codes:
        """The most frequent code of each group, the lowest of several, (groups,)."""
        codes: Codes = np.argmax(self._counts, axis=1).astype(np.uint8)
        return codes

    @property
    def highest(self) -> Codes:
        """The highest code of each group, (groups,)."""
        kinds = self._counts.shape[1]
        codes: Codes = (kinds - 1 - np.argmax(self._counts[:, ::-1] > 0, axis=1)).astype(np.uint8)
        return codes


POINTS = 400
"""The most points of a curve."""
_WIDTH, _HEIGHT = 9.6, 3.1  # inches
_INK, _DIM, _LINE = "#16191d", "#5a6068", "#d5d9de"
_THEME: Mapping[str, str] = {_INK: "var(--ink)", _DIM: "var(--dim)", _LINE: "var(--line)"}
"""Ink of the drawing → that of the page, which is another one in its dark theme and on paper."""
_DOTTED = (0, (0.1, 3.0))
_MOST_LABELS = 12  # curves that are named beside their ends
_LABEL_GAP = 0.075  # a line of text as a fraction of the height
_CLOSE = 100.0  # limits of an axis whose ratio is less have 2 and 5 times the powers of ten, too


@dataclass(frozen=True)
class Curve:
    """One line with its band, its theory and its name. All are functions of x, (c,); NaN where there is none."""

    name: str
    colour: str
    x: Floats
    y: Floats
    low: Floats | None = None
    high: Floats | None = None
    theory: Floats | None = None
    bars: bool = False
    """Marks with error bars from low to high instead of a line with a band."""


@dataclass(frozen=True)
class LogChart:
    """Curves over a common x axis, with a logarithmic y axis."""

    label: str
    """A sentence that says what the chart shows, for screen readers. Charts of one page have different ones."""
    x_name: str
    y_name: str
    curves: Sequence[Curve] = field(default_factory=list)
    x_words: Sequence[str] | None = None
    """Names of the places 0, 1, … of the x axis, if x is not a number."""
    x_range: tuple[float, float] | None = None
    """The ends of the x axis; None: the least and the greatest x."""
    floor: float = 0.0
    """Lesser values lie on the lower edge, and the chart says so. 0: all are shown that are not too far below the highest."""
    y_axis: str = ""
    """The title of the y axis, with its unit."""
    linear: bool = False
    """Whether the y axis is not logarithmic, but linear from 0."""

    @property
    def figure(self) -> Markup | None:
        """The chart as a figure of the page; None if it has nothing to show."""
        curves = [curve if curve.bars else _thinned(curve) for curve in self.curves]
        parts = [(curve.y, curve.theory, *([curve.high] if self.linear else [])) for curve in curves]
        heights = [part for of_curve in parts for part in of_curve if part is not None]
        axis = _linear_axis(heights) if self.linear else ErrorAxis.of(heights, self.floor)
        if axis is None:
            return None
        names = [(curve.name, curve.colour) for curve in curves] if len(curves) > _MOST_LABELS else []
        return made("chart", self.label, self.y_name + axis.words, self._drawing(curves, axis), self.x_name, names)

    def _drawing(self, curves: Sequence[Curve], axis: ErrorAxis) -> Markup:
        style = {
            "axes.edgecolor": _LINE,
            "axes.grid.axis": "y",
            "grid.color": _LINE,
            "path.simplify": False,
            "svg.fonttype": "none",
            "svg.hashsalt": self.label,
            "text.parse_math": False,
            "axes.labelsize": 9.0,
            "xtick.bottom": False,
            "xtick.labelcolor": _DIM,
            "ytick.left": False,
            "ytick.labelcolor": _DIM,
        }
        svg = StringIO()
        with warnings.catch_warnings(), np.errstate(over="ignore"), drawing(_WIDTH, _HEIGHT, style) as figure:
            warnings.filterwarnings("ignore", message="Glyph")  # the page's font draws it
            axes = figure.subplots()
            self._set_axes(axes, curves, axis)
            for curve in curves:
                _draw(axes, curve, axis)
            for curve in curves:  # over the curves, so that it stays visible
                if curve.theory is not None:
                    axes.plot(
                        curve.x,
                        axis.inside(curve.theory),
                        color=_INK,
                        linestyle=_DOTTED,
                        linewidth=1.3,
                        dash_capstyle="round",
                        clip_on=False,
                    )
            if len(curves) <= _MOST_LABELS:
                _label(axes, curves)
            figure.savefig(svg, format="svg", transparent=True, metadata={"Date": None})
        return _embedded(svg.getvalue())

    def _set_axes(self, axes: Axes, curves: Sequence[Curve], axis: ErrorAxis) -> None:
        from matplotlib.ticker import LogLocator  # noqa: PLC0415 - with the figure

        x = np.concatenate([curve.x for curve in self.curves])
        left, right = (float(x.min()), float(x.max())) if self.x_range is None else self.x_range
        if self.x_words is not None:
            axes.set_xticks(range(len(self.x_words)), list(map(printable, self.x_words)))
            left, right = -0.5, len(self.x_words) - 0.5
        else:
            rounding = 1e-9 * max(abs(left), abs(right))
            axes.xaxis.set_major_formatter(lambda at, _: f"{at if abs(at) > rounding else 0.0:,.10g}")
        room = 0.04 * (right - left) if self.x_words is None and any(curve.bars for curve in curves) else 0.0
        room = room or (0.0 if right > left else 0.5)
        axes.set_xlim(left - room, right + room)
        axes.set_ylabel(printable(self.y_axis), color=_DIM)
        if not self.linear:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if axis.high / axis.low < _CLOSE else (1,)))
        axes.set_ylim(axis.low, axis.high)
        axes.yaxis.set_major_formatter(lambda at, _: f"{at:g}")
        axes.minorticks_off()
        for line in axes.get_ygridlines():
            line.set_clip_on(False)


def _draw(axes: Axes, curve: Curve, axis: ErrorAxis) -> None:
    """Draw a curve; a value that is not finite interrupts it. Nothing is clipped, for everything is inside."""
    x, y, ink = curve.x, axis.inside(curve.y), curve.colour
    finite = np.isfinite(curve.y)
    if curve.low is not None and curve.high is not None:
        low, high = axis.inside(curve.low), axis.inside(curve.high)
        bounded = finite & np.isfinite(low) & np.isfinite(high)
        if curve.bars:
            bounded &= low < high
            axes.vlines(x[bounded], low[bounded], high[bounded], colors=ink, linewidths=2.0, clip_on=False)
        else:
            axes.fill_between(x, low, high, where=bounded, color=ink, alpha=0.25, linewidth=0.0, clip_on=False)
    if not curve.bars:
        axes.plot(x, y, color=ink, linewidth=2.0, clip_on=False)
    between = np.concatenate([[False], finite, [False]])
    marked = finite if curve.bars else finite & ~between[:-2] & ~between[2:]  # a line through one point cannot be seen
    if marked.any():
        axes.plot(x[marked], y[marked], "o", color=ink, markersize=6.5 if curve.bars else 4.0, clip_on=False)


def _linear_axis(heights: Sequence[Floats]) -> ErrorAxis | None:
    finite = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in heights)])
    return ErrorAxis(0.0, 1.05 * float(finite.max(initial=0.0)) or 1.0, below=False) if finite.size else None


def _label(axes: Axes, curves: Sequence[Curve]) -> None:
    """Write the name of each curve to the right of its end, in its order, with a mark of its colour; none covers another."""
    ends = [end_of(axes, curve.y) for curve in curves]
    for curve, place in zip(curves, label_places(ends, _LABEL_GAP), strict=True):
        axes.text(1.005, place, "■", color=curve.colour, fontsize=9.0, va="center", transform=axes.transAxes)
        axes.text(1.027, place, printable(curve.name), color=_INK, fontsize=9.0, va="center", transform=axes.transAxes)


def _embedded(svg: str) -> Markup:
    """A drawing of matplotlib as a part of a page: in its inks and its font, and without names of its groups."""
    size = re.search(r'viewBox="[^"]*"', svg)
    assert size is not None  # noqa: S101 - matplotlib writes it
    groups = svg[svg.index('<g id="figure_1">') : svg.rindex("</svg>")]
    groups = re.sub(r'<g id="[\w.]+_\d+"(/?)>', r"<g\1>", groups).replace("xlink:href=", "href=")
    groups = re.sub(r'(<text style="[^"]*)font-family: [^;"]*; ', r"\1", groups)
    # matplotlib 3.10 writes it so
    groups = re.sub(r'(<text style=")font: ([\d.]+px)[^;"]*', r"\1font-size: \2", groups)
    for ink, of_page in _THEME.items():
        groups = groups.replace(f": {ink}", f": {of_page}")
    return Markup(f'<svg {size[0]} aria-hidden="true" focusable="false">\n{groups}</svg>')  # noqa: S704 - escaped by matplotlib


def _thinned(curve: Curve) -> Curve:
    """The curve with at most `POINTS` points, each the mean of its neighbours."""
    count = len(curve.x)
    if count <= POINTS:
        return curve
    given = {name: row for name in ("x", "y", "low", "high", "theory") if (row := getattr(curve, name)) is not None}
    groups = GroupMeans(count, POINTS, len(given))
    groups.add(np.stack([*given.values()]))
    means: dict[str, Any] = dict(zip(given, groups.means, strict=True))
    return replace(curve, **means)
