"""A plant as an application draws it, in place of the curve of what happens, recorded at the view's frames.

A state is an upright bar that is filled up to it, and a power an arrow that is as wide as it is large.

Source: docs/view.md, the house.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.scenario.application import DrawnFlow, DrawnLevel
from evedrop.show.view.column import Column, line_strips
from evedrop.show.view.palette import GROUND, LABEL, PLANT, TRUTH, TRUTH_CURVE, Colour, dim
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.panels.plane import arrow_lines, frames
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "drawing"
_LINES, _BARS, _ARROWS, _WORDS = (f"{_PATH}/{name}" for name in ("lines", "bars", "arrows", "words"))
_HALF_BAR = 0.4  # half the width of a bar
_STROKES, _STROKE = 10, 0.07  # the upright strokes that fill a bar, and half the width of each; lines have round ends
_THIN, _WIDEST = 0.02, 0.16  # half the width of an arrow
_HEAD = 0.25  # length of the head of a thin arrow
_NOTHING = 0.005  # kW, which is 0.00 in words
_LABEL = 0.25  # from a bar's foot down to its words

Strips = NDArray[np.float32]


@final
class DrawnPlant(ViewPanel):
    """What happens, as an application of the plant draws it."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only with an application that has a drawing."""
        return scene.drawing is not None

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        assert scene.drawing is not None  # noqa: S101 - it applies
        self._drawing = scene.drawing
        self._weights = np.array([flow.weights for flow in self._drawing.flows])

    def views(self) -> Iterator[PlacedView]:
        """One view, in the scene."""
        width, height = self._drawing.size
        bounds = rrb.VisualBounds2D(x_range=(0.0, width), y_range=(0.0, height))
        title = self.scene.what_happens
        view = rrb.Spatial2DView(name=title, origin=_PATH, background=list(GROUND), visual_bounds=bounds)
        yield PlacedView(view, "truth")

    def styles(self) -> dict[str, rr.AsComponents]:
        """The lines that do not change, colours, and where the words are."""
        levels, flows = self._drawing.levels, self._drawing.flows
        frames_of_bars = [outline for level in levels for outline in (_frame(level), *_marks(level))]
        places = [(level.foot[0], level.foot[1] + _LABEL) for level in levels]
        places += [flow.label for flow in flows if flow.positive]
        return {
            _LINES: rr.LineStrips2D(
                [*self._drawing.lines, *frames_of_bars], colors=[dim(TRUTH)], radii=rr.Radius.ui_points(1.0)
            ),
            _BARS: rr.LineStrips2D.from_fields(colors=[TRUTH_CURVE], radii=[_STROKE]),
            _ARROWS: rr.LineStrips2D.from_fields(colors=[ink(flow) for flow in flows]),
            _WORDS: rr.Points2D(places, colors=[LABEL], radii=rr.Radius.ui_points(0.0), show_labels=True),
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Bars, arrows and words at the frames."""
        at = frames(self.scene, slots.first, slots.count)
        if slots.moved is None or not len(at):
            return
        k, x, powers = slots.numbers[at], slots.x[at], slots.moved.values[at] @ self._weights.T
        levels, flows = self._drawing.levels, self._drawing.flows
        if levels:
            strips = np.stack([filled(level, x[:, level.state]) for level in levels], axis=1)
            bars = rr.LineStrips2D.columns(strips=line_strips(strips.reshape(-1, *strips.shape[2:])))
            yield Column(_BARS, k, bars.partition([len(levels)] * len(k)))
        if flows:
            widths = half_widths(powers, self._drawing.most)
            strips = np.stack([arrow(flow, powers[:, i], widths[:, i]) for i, flow in enumerate(flows)], axis=1)
            arrows = rr.LineStrips2D.columns(
                strips=line_strips(strips.reshape(-1, *strips.shape[2:])), radii=widths.ravel()
            )
            yield Column(_ARROWS, k, arrows.partition([len(flows)] * len(k)))
        words = [[level_text(level, value, self.scene) for value in x[:, level.state].tolist()] for level in levels]
        words += [
            [flow_text(flow, value) for value in powers[:, i].tolist()] for i, flow in enumerate(flows) if flow.positive
        ]
        labels = [text for texts in zip(*words, strict=True) for text in texts]
        yield Column(_WORDS, k, rr.Points2D.columns(labels=labels).partition([len(words)] * len(k)))


def ink(flow: DrawnFlow) -> Colour:
    """The colour that its disturbance or input has in other panels; of a sum of several, another one."""
    parts = [i for i, weight in enumerate(flow.weights) if weight]
    return PLANT[parts[0] % len(PLANT)] if len(parts) == 1 else TRUTH_CURVE


def height(level: DrawnLevel, values: Floats) -> Floats:
    """How far down values are on a bar, (f,): at most at its foot, and at least at its top."""
    fraction = np.clip((values - level.low) / (level.high - level.low), 0.0, 1.0)
    return level.foot[1] + fraction * (level.top - level.foot[1])


def filled(level: DrawnLevel, values: Floats) -> Strips:
    """The filled part of a bar, from its foot up to values (f,): strokes side by side as one line, (f, p, 2)."""
    foot = level.foot[1] - _STROKE
    inner = _HALF_BAR - _STROKE
    across = level.foot[0] + np.linspace(-inner, inner, _STROKES)
    strokes = np.empty((len(values), _STROKES, 2, 2))
    strokes[..., 0] = across[:, None]
    ends = np.stack([np.full(len(values), foot), np.minimum(height(level, values) + _STROKE, foot)], axis=1)
    strokes[:, ::2, :, 1], strokes[:, 1::2, :, 1] = ends[:, None], ends[:, None, ::-1]
    return strokes.reshape(len(values), 2 * _STROKES, 2).astype(np.float32)


def _frame(level: DrawnLevel) -> list[tuple[float, float]]:
    x, low = level.foot
    left, right = x - _HALF_BAR, x + _HALF_BAR
    return [(left, low), (left, level.top), (right, level.top), (right, low), (left, low)]


def _marks(level: DrawnLevel) -> Iterator[list[tuple[float, float]]]:
    for value in level.marks:
        x, y = level.foot[0], float(height(level, np.array([value]))[0])
        yield [(x + 0.6 * _HALF_BAR, y), (x + 1.4 * _HALF_BAR, y)]


def half_widths(powers: Floats, most: float) -> Strips:
    """Half the widths of arrows, as large as the powers are, (f, a); those of a power of nothing can hardly be seen."""
    return np.maximum(_THIN, _WIDEST * np.abs(powers) / most).astype(np.float32)


def arrow(flow: DrawnFlow, powers: Floats, widths: Strips) -> Strips:
    """An arrow for each power, (f, 5, 2): a shaft and both sides of its head; a dot at its start where the power is nothing.

    widths: half the width of each, (f,).
    """
    start, end = np.array(flow.start), np.array(flow.end)
    backwards = (powers < 0.0)[:, None]
    tails, tips = np.where(backwards, end, start), np.where(backwards, start, end)
    tips = np.where((np.abs(powers) < _NOTHING)[:, None], tails, tips)
    along = (tips - tails) / np.maximum(np.hypot(*(tips - tails).T), 1e-9)[:, None]
    return arrow_lines(tails, tips, along, (_HEAD + 2.0 * widths)[:, None]).astype(np.float32)


def level_text(level: DrawnLevel, value: float, scene: Scene) -> str:
    """Such as "battery 51.3 %"."""
    unit = f" {scene.units[level.state]}" if scene.units and scene.units[level.state] else ""
    return f"{level.name} {value:.1f}{unit}"


def flow_text(flow: DrawnFlow, power: float) -> str:
    """Such as "load 0.43 kW"; the words of a flow that is negative tell that, unless it has a sign."""
    shown = 0.0 if abs(power) < _NOTHING else power
    number = f"{shown:+.2f}" if flow.signed else f"{abs(shown):.2f}"
    return f"{flow.negative if shown < 0.0 else flow.positive} {number.replace('-', '−')} kW"
