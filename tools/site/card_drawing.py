"""Moving pictures of runs, for the cards of the gallery: SVG files of some kilobytes, which move without a script.

Above is the plane of the first two states, or a single state over time, with a ring for the truth and a dot for each estimate.
Below is how far off each receiver is over the whole run, with a line at the time of the upper part.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evedrop.show.view.palette import GROUND, TRUTH, TRUTH_CURVE, hexadecimal

Floats = NDArray[np.float64]

_WIDTH, _HEIGHT = 320, 180
_WORLD = (10.0, 8.0, 310.0, 112.0)  # left, top, right, bottom
_STRIP = (10.0, 134.0, 310.0, 174.0)
_SECONDS = 8
_MOST_FRAMES = 120
_MOST_POINTS = 150
_MARGIN = 0.12
_LETTER, _GAP = 5.8, 10.0  # pixels, about
_DECADES = 8.0


@dataclass(frozen=True)
class Curve:
    """A line of the lower part."""

    ink: str
    values: Floats
    dashed: bool = False


@dataclass(frozen=True)
class Shown:
    """What a card shows."""

    title: str
    slots: range
    """Those in which the dots move, of a run of `of` slots."""
    of: int
    truth: Floats
    """(slots, 1 or 2): places in the upper part."""
    estimates: Mapping[str, Floats]
    """Receiver → its estimates, as `truth`."""
    inks: Mapping[str, str]
    curves: Sequence[Curve]
    logarithmic: bool = True
    reach: Floats | None = None
    """How far from 0 the upper part shows places, (1 or 2,); None: as far as the truth goes."""


def card(shown: Shown, *, dark: bool, moves: bool = True) -> str:
    """The picture as SVG."""
    ground, truth = (hexadecimal(GROUND), hexadecimal(TRUTH)) if dark else ("#f6f7f8", hexadecimal(TRUTH_CURVE))
    title = html.escape(shown.title)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="{ground}"/>',
        *_world(shown, truth, moves=moves),
        *_names(shown),
        *_strip(shown, truth, moves=moves),
        "</svg>",
    ]
    return "".join(parts)


def _world(shown: Shown, truth: str, *, moves: bool) -> Iterator[str]:
    """The places, with faint traces of them."""
    frames = _chosen(len(shown.truth), _MOST_FRAMES)
    places = {**shown.estimates, "truth": shown.truth}  # the truth is a ring around the others
    if shown.truth.shape[1] == 1:
        time = np.arange(len(shown.truth), dtype=np.float64)[:, None]
        places = {name: np.hstack([time, values]) for name, values in places.items()}
    low, high = places["truth"].min(axis=0), places["truth"].max(axis=0)
    if shown.reach is not None:
        low, high = -shown.reach, shown.reach
    margin = _MARGIN * np.where(high > low, high - low, 1.0)
    left, top, right, bottom = _WORLD
    size = np.array([right - left, bottom - top])
    for name, values in places.items():
        inside = np.clip((values - low + margin) / (high - low + 2 * margin), 0.0, 1.0)
        x, y = (np.array([left, bottom]) + inside * size * [1.0, -1.0]).T
        ink = truth if name == "truth" else shown.inks[name]
        if name in ("truth", next(iter(shown.estimates))):
            points = _points(x[frames], y[frames])
            yield f'<polyline points="{points}" fill="none" stroke="{ink}" stroke-width="1.2" opacity=".6"/>'
        else:
            dots = "".join(f"M{a:.0f} {b:.0f}h0" for a, b in zip(x[frames], y[frames], strict=True))
            yield f'<path d="{dots}" stroke="{ink}" stroke-width="2.5" stroke-linecap="round" opacity=".55"/>'
        radius = 6 if name == "truth" else 4
        fill = "none" if name == "truth" else ink
        stroke = f' stroke="{ink}" stroke-width="2"' if name == "truth" else ""
        yield f'<circle r="{radius}" fill="{fill}"{stroke} cx="{x[frames][-1]:.0f}" cy="{y[frames][-1]:.0f}">'
        if moves:
            yield _moving("cx", x[frames])
            yield _moving("cy", y[frames])
        yield "</circle>"


def _names(shown: Shown) -> Iterator[str]:
    """The names of the receivers, in their colours."""
    x, widths = _WORLD[0], [_LETTER * len(name) + _GAP for name in shown.estimates]
    smaller = min(1.0, (_WORLD[2] - x) / sum(widths))
    for name, width in zip(shown.estimates, widths, strict=True):
        size = f'font-family="sans-serif" font-size="{10 * smaller:.1f}"'
        yield f'<text x="{x:.0f}" y="126" fill="{shown.inks[name]}" {size}>{html.escape(name)}</text>'
        x += width * smaller


def _strip(shown: Shown, ink: str, *, moves: bool) -> Iterator[str]:
    """The curves over the whole run, and a line at the time of the upper part."""
    left, top, right, bottom = _STRIP
    values = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in shown.curves])
    if shown.logarithmic:
        high = np.log10(values.max()) if values.max() > 0 else 0.0
        low = max(np.log10(values[values > 0].min()) if (values > 0).any() else -1.0, high - _DECADES)
    else:
        low, high = min(values.min(), 0.0), values.max()
    span = (high - low) or 1.0
    for curve in shown.curves:
        chosen = _chosen(len(curve.values), _MOST_POINTS)
        heights = curve.values[chosen]
        if shown.logarithmic:
            heights = np.log10(np.maximum(heights, 10.0**low))
        y = bottom - (heights - low) / span * (bottom - top)
        x = left + chosen / max(1, len(curve.values) - 1) * (right - left)
        good = np.isfinite(y)
        dashes = ' stroke-dasharray="3 3"' if curve.dashed else ""
        points = _points(x[good], y[good])
        yield f'<polyline points="{points}" fill="none" stroke="{curve.ink}" stroke-width="1.5"{dashes}/>'
    first, last = (left + slot / max(1, shown.of - 1) * (right - left) for slot in (shown.slots[0], shown.slots[-1]))
    yield f'<path d="M0 {top - 2:.0f}V{bottom + 2:.0f}" stroke="{ink}" opacity=".7" transform="translate({last:.0f})">'
    if moves:
        yield (
            f'<animateTransform attributeName="transform" type="translate" from="{first:.1f}" to="{last:.1f}" '
            f'dur="{_SECONDS}s" repeatCount="indefinite"/>'
        )
    yield "</path>"


def _moving(attribute: str, values: Floats) -> str:
    places = ";".join(f"{value:.0f}" for value in values)
    return f'<animate attributeName="{attribute}" values="{places}" dur="{_SECONDS}s" repeatCount="indefinite"/>'


def _points(x: Floats, y: Floats) -> str:
    return " ".join(f"{a:.0f},{b:.0f}" for a, b in zip(x, y, strict=True))


def _chosen(count: int, most: int) -> NDArray[np.int64]:
    """At most so many indices, evenly spread, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
