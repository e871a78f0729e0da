"""Charts as HTML and SVG, written without a plotting library, in a hundredth of a second.

Only the curves are SVG, stretched to the width of the page; the words around them are HTML, so that they stay readable at any
width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree as ET

import numpy as np

from evedrop.model.process import Floats
from evedrop.show.report.groups import GroupMeans
from evedrop.show.report.markup import Node, element
from evedrop.show.view.error_floor import floor_words

POINTS = 400
"""The most points of a curve."""
_WIDE, _HIGH = 2000, 1000  # of the drawing, in its own units
_MOST_DECADES = 30  # shown below the highest value
_TICKS = 6


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
    """A sentence that says what the chart shows, for screen readers."""
    x_name: str
    y_name: str
    curves: Sequence[Curve] = field(default_factory=list)
    x_words: Sequence[str] | None = None
    """Names of the places 0, 1, … of the x axis, if x is not a number."""
    x_range: tuple[float, float] | None = None
    """The ends of the x axis; None: the least and the greatest x."""
    floor: float = 0.0
    """Lesser values lie on the lower edge, and the chart says so. 0: all are shown that are not too far below the highest."""

    @property
    def node(self) -> Node | None:
        """The chart; None if it has nothing to show."""
        curves = [one if one.bars else _thinned(one) for one in self.curves]
        heights = [part for one in curves for part in (one.y, one.theory) if part is not None]
        known = np.concatenate([part[np.isfinite(part)] for part in heights]) if heights else np.empty(0)
        below = bool((known < self.floor).any())
        positive = np.maximum(known, self.floor)
        positive = positive[positive > 0.0]
        if not positive.size:
            return None
        top = float(np.log10(positive.max()))
        bottom = max(float(np.log10(positive.min())), top - _MOST_DECADES)
        top = max(top, bottom + 1.0) if below else top
        x = np.concatenate([one.x for one in self.curves])
        left, right = (float(x.min()), float(x.max())) if self.x_range is None else self.x_range
        room = 0.05 * (top - bottom + 0.2)
        axes = _Axes(left, right, bottom - (0.0 if below else room), top + room)
        if any(one.bars for one in curves):  # room for the marks
            room = 0.04 * (axes.right - axes.left)
            axes = _Axes(axes.left - room, axes.right + room, axes.bottom, axes.top)
        if self.x_words is not None:
            axes = _Axes(-0.5, len(self.x_words) - 0.5, axes.bottom, axes.top)
        drawing = element(
            "svg", viewBox=f"0 0 {_WIDE} {_HIGH}", preserveAspectRatio="none", aria_hidden="true", focusable="false"
        )
        labels = []
        for text, at in _log_ticks(axes.bottom, axes.top):
            place = axes.v(np.array([10.0**at]))[0]
            drawing.append(element("path", d=f"M0 {place}H{_WIDE}", class_="grid"))
            labels.append(element("span", text, class_="y", style=f"top:{place / _HIGH:.2%}"))
        words = [(word, float(i)) for i, word in enumerate(self.x_words)] if self.x_words is not None else None
        for text, at in words or _ticks(axes.left, axes.right):
            labels.append(element("span", text, class_="x", style=f"left:{axes.h(np.array([at]))[0] / _WIDE:.2%}"))
        for one in curves:
            drawing.extend(_drawn(one, axes))
        for one in curves:  # drawn over the curves, so that it stays visible
            if one.theory is not None:
                parts = _parts(axes.h(one.x), axes.v(one.theory), np.isfinite(one.theory))
                drawing.append(element("path", d=_path(parts), class_="theory"))
        plot = element("div", drawing, *labels, class_="plot", role="img", aria_label=self.label)
        return element(
            "figure",
            element("div", f"{self.y_name}; {floor_words(self.floor)}" if below else self.y_name, class_="axis"),
            plot,
            element("div", self.x_name, class_="axis below"),
            element("figcaption", *legend([(one.name, one.colour) for one in curves])),
            class_="chart",
        )


def legend(entries: Sequence[tuple[str, str]]) -> list[Node]:
    """Names with their colours."""
    return [
        element("span", element("span", class_="swatch", style=f"background:{colour}"), name, class_="key")
        for name, colour in entries
    ]


@dataclass(frozen=True)
class _Axes:
    left: float
    right: float
    bottom: float
    """The decimal logarithm of the lowest value shown."""
    top: float

    def h(self, x: Floats) -> list[int]:
        """Places from the left, in the units of the drawing."""
        span = self.right - self.left or 1.0
        return [round(_WIDE * float(one - self.left) / span) for one in x]

    def v(self, y: Floats) -> list[int]:
        """Places from the top; values below the lowest one lie on the lower border."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip((np.log10(y) - self.bottom) / (self.top - self.bottom), 0.0, 1.0)
        return [round(_HIGH * (1.0 - float(one))) for one in np.nan_to_num(share)]


def _drawn(one: Curve, axes: _Axes) -> list[ET.Element]:
    """The elements of a curve; a value that is not finite interrupts it."""
    across, found = axes.h(one.x), list[ET.Element]()
    bounds = None if one.low is None or one.high is None else (axes.v(one.low), axes.v(one.high))
    known = np.isfinite(one.y)
    if bounds is not None and not one.bars:
        some = [i for i in np.flatnonzero(known) if np.isfinite(one.low[i]) and np.isfinite(one.high[i])]  # type: ignore[index]
        if len(some) > 1:
            edge = [(across[i], bounds[1][i]) for i in some] + [(across[i], bounds[0][i]) for i in reversed(some)]
            found.append(element("path", d=_path([edge]) + "Z", class_="band", style=f"fill:{one.colour}"))
    down = axes.v(one.y)
    if not one.bars:
        path = _path(_parts(across, down, known))
        found.append(element("path", d=path, class_="curve", style=f"stroke:{one.colour}"))
        return found
    for i in np.flatnonzero(known):
        if bounds is not None and bounds[0][i] != bounds[1][i]:
            bar = f"M{across[i]} {bounds[0][i]}V{bounds[1][i]}"
            found.append(element("path", d=bar, class_="bar", style=f"stroke:{one.colour}"))
        found.append(element("path", d=f"M{across[i]} {down[i]}h0", class_="mark", style=f"stroke:{one.colour}"))
    return found


def _parts(across: Sequence[int], down: Sequence[int], known: np.ndarray) -> list[list[tuple[int, int]]]:
    """The points of a curve, in a list for each stretch without a gap."""
    parts: list[list[tuple[int, int]]] = [[]]
    for i, there in enumerate(known):
        if there:
            parts[-1].append((across[i], down[i]))
        elif parts[-1]:
            parts.append([])
    return [part for part in parts if part]


def _path(parts: Sequence[Sequence[tuple[int, int]]]) -> str:
    return "".join(f"M{part[0][0]} {part[0][1]}" + "".join(f"L{x} {y}" for x, y in part[1:] or part) for part in parts)


def _thinned(one: Curve) -> Curve:
    """The curve with at most `POINTS` points, each the mean of its neighbours."""
    count = len(one.x)
    if count <= POINTS:
        return one
    rows = [one.x, one.y, one.low, one.high, one.theory]
    given = [row for row in rows if row is not None]
    groups = GroupMeans(count, POINTS, len(given))
    groups.add(np.stack(given))
    means = iter(groups.means)
    x, y, low, high, theory = (None if row is None else next(means) for row in rows)
    assert x is not None  # noqa: S101 - it was given
    assert y is not None  # noqa: S101 - the same
    return Curve(one.name, one.colour, x, y, low, high, theory)


def _ticks(low: float, high: float) -> list[tuple[str, float]]:
    """Round numbers between two limits."""
    if not high > low:
        return [(f"{low:g}", low)]
    step = 10.0 ** math.floor(math.log10((high - low) / _TICKS))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (factor * step) <= _TICKS)
    places = range(math.ceil(low / step), math.floor(high / step + 1e-9) + 1)
    return [(f"{round(i * step, 12):,g}" if abs(i * step) < 1e6 else f"{i * step:g}", i * step) for i in places]


def _log_ticks(low: float, high: float) -> list[tuple[str, float]]:
    """Powers of ten between two limits, given as decimal logarithms; with 2 and 5 times them between close limits."""
    step = max(1, math.ceil((high - low) / _TICKS))
    factors = (1, 2, 5) if high - low < 2.0 else (1,)
    found = [
        (f"{factor * 10.0**power:g}", power + math.log10(factor))
        for power in range(math.floor(low), math.ceil(high) + 1)
        if power % step == 0
        for factor in factors
    ]
    inside = [(text, at) for text, at in found if low <= at <= high]
    return inside or [(f"{10.0**at:.3g}", at) for at in (low, high)]
