"""Charts with a logarithmic axis for the page, and the means of neighbours that a chart of a long run draws.

They are SVG that takes its inks and its font from the page; matplotlib would take as long as a small study. Long rows of numbers
are taken piece by piece, in a few groups of neighbours, so that memory does not grow with their length.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, final
from unicodedata import east_asian_width

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags
from evedrop.show.report.page import made, printable
from evedrop.show.view.error_floor import ErrorAxis, floor_words
from evedrop.show.view.label_places import label_places


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
_WIDTH, _HEIGHT = 691.0, 223.0
_TOP, _BOTTOM = 8.0, 203.0
"""The ends of the y axis."""
_GAP, _TITLE, _TEXT = 7.0, 16.0, 9.0
"""Between axes and words; the room for the title of the y axis; and the height of letters."""
_LETTER = 5.7
"""The width of a letter: a page may have any font."""
_INK, _DIM, _LINE = "var(--ink)", "var(--dim)", "var(--line)"
"""Inks of the page, which are others in its dark theme and on paper."""
_MOST_TICKS = 9
_MOST_LABELS, _LABEL_GAP = (
    12,
    0.075,
)  # curves that are named beside their ends; a line of text as a fraction of the height
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
        above = f"{self.y_name}; {floor_words(self.floor)}" if axis.below else self.y_name
        names = [(curve.name, curve.colour) for curve in curves] if len(curves) > _MOST_LABELS else []
        drawing = _DrawnChart(self, curves, axis)
        return made("chart", self.label, above, drawing.svg, self.x_name, names)

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the x axis, with room for marks."""
        if self.x_words is not None:
            return -0.5, len(self.x_words) - 0.5
        x = np.concatenate([curve.x for curve in self.curves])
        left, right = (float(x.min()), float(x.max())) if self.x_range is None else self.x_range
        room = 0.04 * (right - left) if any(curve.bars for curve in self.curves) else 0.0
        room = room or (0.0 if right > left else 0.5)
        return left - room, right + room


@final
class _DrawnChart:
    """Draws a chart. Nothing is clipped, for everything is inside."""

    def __init__(self, chart: LogChart, curves: Sequence[Curve], axis: ErrorAxis) -> None:
        self._chart, self._curves, self._axis = chart, curves, axis
        self._names = [printable(curve.name) for curve in curves] if len(curves) <= _MOST_LABELS else []
        self._heights = {f"{at:g}": at for at in _round(axis) if axis.low <= at <= axis.high}
        self._left = _TITLE + _GAP + _LETTER * max(map(len, self._heights))
        self._right = _WIDTH - 3 * _GAP - _LETTER * max(map(_width, self._names), default=0)

    @property
    def svg(self) -> Markup:
        """The drawing."""
        parts = [*self._axes(), *(part for curve in self._curves for part in self._drawn(curve))]
        for curve in self._curves:  # over the curves, so that it stays visible
            if curve.theory is not None:
                dotted = f"stroke: {_INK}; stroke-width: 1.3; stroke-dasharray: 0.1 3.9; stroke-linecap: round"
                parts.append(self._line(curve.x, self._axis.inside(curve.theory), dotted))
        parts += self._labels()
        size = Markup('<svg viewBox="0 0 {:g} {:g}" aria-hidden="true" focusable="false">\n{}\n</svg>')
        return size.format(_WIDTH, _HEIGHT, Markup("\n").join(parts))

    def _axes(self) -> Iterator[Markup]:
        (first, last), words = self._chart.ends, self._chart.x_words
        for name, at in self._heights.items():
            y = self._y(np.array([at]))[0]
            yield _path([[(self._left, y), (self._right, y)]], f"stroke: {_LINE}; stroke-width: 0.6")
            yield _text(self._left - _GAP, y, name, "end", _DIM)
        corners = [(self._left, _TOP), (self._left, _BOTTOM), (self._right, _BOTTOM)]
        for side in pairwise(corners):
            yield _path([side], f"stroke: {_LINE}; stroke-width: 0.7")
        places = {f"{round(at, 12):,g}": at for at in _steps(first, last)}
        for name, at in places.items() if words is None else zip(words, range(len(words)), strict=True):
            yield _text(self._x(np.array([at]))[0], _BOTTOM + _GAP + _TEXT / 2, printable(name), "middle", _DIM)
        title = _text(0.0, 0.0, printable(self._chart.y_axis), "middle", _DIM)
        turned = Markup('<g transform="translate({:.1f} {:.1f}) rotate(-90)">{}</g>')
        yield turned.format(_TEXT, (_TOP + _BOTTOM) / 2, title)

    def _drawn(self, curve: Curve) -> Iterator[Markup]:
        """A curve with its band; a value that is not finite interrupts it."""
        x, y = curve.x, self._axis.inside(curve.y)
        finite = np.isfinite(y)
        if curve.low is not None and curve.high is not None:
            low, high = self._axis.inside(curve.low), self._axis.inside(curve.high)
            bounded = finite & np.isfinite(low) & np.isfinite(high)
            if curve.bars:
                ends = zip(*(self._points(x, side)[bounded & (low < high)] for side in (low, high)), strict=True)
                yield _path(ends, f"stroke: {curve.colour}; stroke-width: 2")
            else:
                edges = [self._points(x, side) for side in (low, high)]
                around = [np.concatenate([edges[0][run], edges[1][run][::-1]]) for run in _runs(bounded)]
                yield _path(around, f"fill: {curve.colour}; fill-opacity: 0.25; stroke: none")
        if not curve.bars:
            yield self._line(x, y, f"stroke: {curve.colour}; stroke-width: 2")
        alone = [
            run.start for run in _runs(finite) if run.stop - run.start == 1
        ]  # a line through one point cannot be seen
        for left, top in self._points(x, y)[finite if curve.bars else alone]:
            dot = Markup('<circle cx="{:.2f}" cy="{:.2f}" r="{}" style="fill: {}"/>')
            yield dot.format(left, top, 3.75 if curve.bars else 2.5, curve.colour)

    def _line(self, x: Floats, y: Floats, style: str) -> Markup:
        points = self._points(x, y)
        return _path([points[run] for run in _runs(np.isfinite(y)) if run.stop - run.start > 1], style)

    def _labels(self) -> Iterator[Markup]:
        """The name of each curve to the right of its end, in its order, with a mark of its colour; none covers another."""
        ends = [self._end(curve.y) for curve in self._curves[: len(self._names)]]
        places = label_places([(_BOTTOM - end) / (_BOTTOM - _TOP) for end in ends], _LABEL_GAP)
        for curve, name, place in zip(self._curves, self._names, places, strict=False):
            y = _BOTTOM - place * (_BOTTOM - _TOP)
            yield _text(self._right + 0.5 * _GAP, y, "■", "start", curve.colour)
            yield _text(self._right + 2.4 * _GAP, y, name, "start", _INK)

    def _end(self, heights: Floats) -> float:
        """Where a curve of these heights ends; at the lower end of the axis if it has none."""
        finite = heights[np.isfinite(heights)]
        return float(self._y(self._axis.inside(finite[-1:]))[0]) if finite.size else _BOTTOM

    def _points(self, x: Floats, y: Floats) -> Floats:
        """Values of the axes on the drawing, (c, 2)."""
        return np.stack([self._x(x), self._y(y)], axis=1)

    def _x(self, values: Floats) -> Floats:
        first, last = self._chart.ends
        return self._left + (values - first) / (last - first) * (self._right - self._left)

    def _y(self, values: Floats) -> Floats:
        ends = np.array([self._axis.low, self._axis.high])
        low, high = ends if self._chart.linear else np.log10(ends)
        heights = values if self._chart.linear else np.log10(values)
        places: Floats = _BOTTOM - (heights - low) / (high - low) * (_BOTTOM - _TOP)
        return places


def _path(lines: Iterable[Iterable[Any]], style: str) -> Markup:
    """Lines through points, as one path."""
    drawn = " ".join("M " + " L ".join(f"{x:.2f} {y:.2f}" for x, y in line) for line in lines)
    return Markup('<path d="{}" style="fill: none; {}"/>').format(drawn, style)


def _text(x: float, y: float, text: str, anchor: str, ink: str) -> Markup:
    """A line of text, half a letter's height above and below y."""
    style = f"font-size: {_TEXT:g}px; text-anchor: {anchor}; fill: {ink}"
    return Markup('<text x="{:.2f}" y="{:.2f}" style="{}">{}</text>').format(x, y + 0.36 * _TEXT, style, text)


def _width(text: str) -> int:
    """How many letters wide a text is."""
    return sum(2 if east_asian_width(letter) in "FW" else 1 for letter in text)


def _runs(there: Flags) -> list[slice]:
    """The longest stretches of neighbours that are there, (c,)."""
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    return [slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def _steps(low: float, high: float) -> list[float]:
    """Round numbers at equal distances, from low to high."""
    least = (high - low) / _MOST_TICKS
    power = 10.0 ** math.floor(math.log10(least))
    step = next(step for step in (power, 2 * power, 2.5 * power, 5 * power, 10 * power) if step >= least)
    return [step * i for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _round(axis: ErrorAxis) -> list[float]:
    """Numbers at an axis: round ones if it begins at 0, otherwise powers of ten, and others if there are few of them."""
    if axis.low == 0.0:
        return _steps(axis.low, axis.high)
    first, last = math.floor(math.log10(axis.low)), math.floor(math.log10(axis.high))
    factors = (1, 2, 5) if axis.high / axis.low < _CLOSE else (1,)
    every = math.ceil((last - first + 1) / _MOST_TICKS)
    return [float(f"{factor}e{power}") for power in range(first - first % every, last + 1, every) for factor in factors]


def _linear_axis(heights: Sequence[Floats]) -> ErrorAxis | None:
    finite = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in heights)])
    return ErrorAxis(0.0, 1.05 * float(finite.max(initial=0.0)) or 1.0, below=False) if finite.size else None


def _thinned(curve: Curve) -> Curve:
    """The curve with at most `POINTS` points, each the mean of its neighbours."""
    count = len(curve.x)
    if count <= POINTS:
        return curve
    rows = [curve.x, curve.y, curve.low, curve.high, curve.theory]
    given = [row for row in rows if row is not None]
    groups = GroupMeans(count, POINTS, len(given))
    groups.add(np.stack(given))
    means = iter(groups.means)
    x, y, low, high, theory = (None if row is None else next(means) for row in rows)
    assert x is not None  # noqa: S101 - it was given
    assert y is not None  # noqa: S101 - the same
    return Curve(curve.name, curve.colour, x, y, low, high, theory)
