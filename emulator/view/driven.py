"""A plant with a controller in the view: inputs and disturbances, true and estimated levels, and the panels of applications.

Source: docs/view.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.scenario.application import Panel
from evedrop.view import paths
from evedrop.view.column import Column, scalars
from evedrop.view.palette import TRUTH_CURVE, Colour, colour
from evedrop.view.scene import Moved, Scene, SceneSlots

_MOST_POINTS = 20_000  # of a curve over a run: a day of one-second slots is drawn every five seconds
_MOVING: tuple[Colour, ...] = (
    (226, 178, 40),
    (222, 92, 82),
    (80, 150, 235),
    (60, 180, 120),
    (170, 120, 230),
    (140, 140, 140),
)


def columns(scene: Scene, k: NDArray[np.int64], slots: SceneSlots, moved: Moved) -> Iterator[Column]:
    """The columns of some slots k."""
    every = math.ceil(scene.slots / _MOST_POINTS)
    at = np.flatnonzero(k % every == 0)
    if len(at):
        for label, values in zip(scene.moving, moved.values.T, strict=True):
            yield scalars(_moving(label), k[at], values[at])
        for i in range(scene.n):
            yield scalars(_level(i, paths.TRUTH), k[at], slots.x[at, i])
            for name, peer in slots.peers.items():
                yield scalars(_level(i, name), k[at], peer.x_hat[at, i])
    for panel in scene.panels:
        for curve in panel.curves:
            path = f"{panel.path}/{curve.name}"
            slots_of, values = moved.curves[path]
            drawn = slice(None) if curve.drawn == "points" else slots_of % every == 0
            if len(slots_of[drawn]):
                yield scalars(path, slots_of[drawn].astype(np.int64), values[drawn])


def log_styles(to: rr.RecordingStream, scene: Scene) -> None:
    """Log names and colours, once."""
    if not scene.moving:
        return
    for i, label in enumerate(scene.moving):
        _line(to, _moving(label), label, _MOVING[i % len(_MOVING)], 1.4, steps=True)
    for i in range(scene.n):
        _line(to, _level(i, paths.TRUTH), "truth", TRUTH_CURVE, 1.8)
        for j, shown in enumerate(scene.receivers):
            _line(to, _level(i, shown.name), shown.name, colour(j), 0.9)
    of_receivers = {shown.name: colour(j) for j, shown in enumerate(scene.receivers)}
    for panel in scene.panels:
        for curve in panel.curves:
            path, bright = f"{panel.path}/{curve.name}", curve.colour or of_receivers[curve.name]
            if curve.drawn == "points":
                style = rr.SeriesPoints(names=curve.name, colors=bright, markers="circle", marker_sizes=curve.width)
                to.log(path, style, static=True)
            else:
                _line(to, path, curve.name, bright, curve.width, steps=curve.drawn == "steps")


def panels(scene: Scene, axis: rrb.TimeAxis) -> list[rrb.View]:
    """The inputs and disturbances, a panel for each of the first two levels, and the applications' panels of the plant."""
    found: list[rrb.View] = [_panel("What moves the plant: " + ", ".join(scene.moving), paths.MOVING, axis)]
    for i in range(min(scene.n, 2)):
        label = scene.states[i] if scene.states else f"state {i}"
        title = f"{label}   grey: truth · others coloured as their curves: what they believe"
        found.append(_panel(title, f"{paths.LEVELS}/{i}", axis))
    return found + [_application_panel(panel, axis) for panel in scene.panels if not panel.beside]


def beliefs(scene: Scene, axis: rrb.TimeAxis) -> list[rrb.View]:
    """The applications' panels of what receivers believe."""
    return [_application_panel(panel, axis) for panel in scene.panels if panel.beside]


def _application_panel(panel: Panel, axis: rrb.TimeAxis) -> rrb.TimeSeriesView:
    span = None if panel.span is None else rrb.ScalarAxis(range=panel.span, zoom_lock=True)
    return _panel(panel.title, panel.path, axis, span)


def _panel(title: str, origin: str, axis: rrb.TimeAxis, values: rrb.ScalarAxis | None = None) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(name=title, origin=f"/{origin}", axis_x=axis, axis_y=values, plot_legend=legend)


def _line(to: rr.RecordingStream, path: str, label: str, bright: Colour, width: float, *, steps: bool = False) -> None:
    mode: Literal["StepAfter", "Linear"] = "StepAfter" if steps else "Linear"
    to.log(path, rr.SeriesLines(names=label, colors=bright, widths=width, interpolation_mode=mode), static=True)


def _moving(label: str) -> str:
    return f"{paths.MOVING}/{re.sub(r'[^A-Za-z0-9_-]+', '_', label)}"


def _level(i: int, name: str) -> str:
    return f"{paths.LEVELS}/{i}/{name}"
