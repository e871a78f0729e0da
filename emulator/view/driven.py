"""A plant with a controller in the view: inputs and disturbances, true and estimated levels, and a house's energies.

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

from evedrop.view import paths
from evedrop.view.column import Column, scalars
from evedrop.view.palette import TRUTH_CURVE, Colour, colour
from evedrop.view.scene import Moved, Scene, SceneSlots

_MOST_POINTS = 20_000  # of a curve over a run: a day of one-second slots is drawn every five seconds
_MOVING: tuple[Colour, ...] = (
    (226, 178, 40),  # the first disturbance, of a house the sun
    (222, 92, 82),
    (80, 150, 235),
    (60, 180, 120),
    (170, 120, 230),
    (140, 140, 140),
)
BOUGHT: Colour = (222, 92, 82)
SOLD: Colour = (60, 180, 120)


def columns(scene: Scene, k: NDArray[np.int64], slots: SceneSlots, moved: Moved) -> Iterator[Column]:
    """The columns of some slots k."""
    at = np.flatnonzero(k % math.ceil(scene.slots / _MOST_POINTS) == 0)
    if len(at):
        for label, values in zip(scene.moving, moved.values.T, strict=True):
            yield scalars(_moving(label), k[at], values[at])
        for i in range(scene.n):
            yield scalars(_level(i, paths.TRUTH), k[at], slots.x[at, i])
            for name, peer in slots.peers.items():
                yield scalars(_level(i, name), k[at], peer.x_hat[at, i])
        if moved.energies is not None:
            for name, values in zip(("bought", "sold"), moved.energies.T, strict=True):
                yield scalars(f"{paths.ENERGY}/{name}", k[at], values[at])
        if scene.house is not None:
            load = scene.moving.index(scene.house.load)
            yield scalars(f"{paths.GUESSES}/{paths.TRUTH}", k[at], moved.values[at, load])
    for name, guess in moved.guesses.items():
        if guess.shape[1]:
            yield scalars(f"{paths.GUESSES}/{name}", guess[0].astype(np.int64), guess[1])


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
    if scene.house is not None:
        _line(to, f"{paths.ENERGY}/bought", "bought", BOUGHT, 1.8)
        _line(to, f"{paths.ENERGY}/sold", "sold", SOLD, 1.8)
        _line(to, f"{paths.GUESSES}/{paths.TRUTH}", "truth", TRUTH_CURVE, 1.4, steps=True)
        for j, shown in enumerate(scene.receivers):
            # Points: a guess that jumps appears as a cloud, and hides no other.
            style = rr.SeriesPoints(names=shown.name, colors=colour(j), markers="circle", marker_sizes=1.6)
            to.log(f"{paths.GUESSES}/{shown.name}", style, static=True)


def panels(scene: Scene, axis: rrb.TimeAxis) -> list[rrb.View]:
    """The inputs and disturbances, a panel for each of the first two levels, and for a house the energy bought and sold."""
    found: list[rrb.View] = [_panel("What moves the plant: " + ", ".join(scene.moving), paths.MOVING, axis)]
    for i in range(min(scene.n, 2)):
        label = scene.states[i] if scene.states else f"state {i}"
        title = f"{label}   grey: truth · others coloured as their curves: what they believe"
        found.append(_panel(title, f"{paths.LEVELS}/{i}", axis))
    if scene.house is not None:
        found.append(_panel("Energy bought and sold (kWh)", paths.ENERGY, axis))
    return found


def guessed(scene: Scene, axis: rrb.TimeAxis) -> list[rrb.View]:
    """For a house, the load and every receiver's guess of it."""
    if scene.house is None:
        return []
    title = f"{scene.house.load}, and what each would guess from its estimate"
    least, most = -0.1 * scene.house.most, 1.15 * scene.house.most
    return [_panel(title, paths.GUESSES, axis, rrb.ScalarAxis(range=(least, most), zoom_lock=True))]


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
