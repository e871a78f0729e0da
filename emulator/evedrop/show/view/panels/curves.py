"""The panels of curves over time, and what they share: axes, views, styles, logarithms.

The curves are errors and covariances of the receivers, states and their estimates, what moves the plant of a closed loop, and
what the scenario's applications describe.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.archetypes import PlotBackground

from evedrop.model.process import Floats
from evedrop.show.view.attacks import Attacks, lane_count
from evedrop.show.view.column import CLOCK, Column, SlotTimes, scalars
from evedrop.show.view.error_floor import error_floor, mean_band
from evedrop.show.view.palette import GROUND, PLANT, TRUTH_CURVE, Colour, dim
from evedrop.show.view.panels.panel import PlacedView, ViewPanel, crowded
from evedrop.show.view.scene import TRUTH_NAME, Scene, SceneSlots

_WINDOW = 105  # slots; below four pixels a slot, Rerun merges neighbouring slots into grey
_ROOM = 3  # slots to the right of the present, so that the newest slot is not at the border
_ROOM_FOR_DATE, _HIDDEN = 25, 500  # parts of a run: half of a date, and a pixel
_USUAL, _UNITS = 2.5, 4.5  # powers of ten over which errors extend without growth; units of an axis
_LONG = 5  # powers of ten that are not written out
_MOST_POINTS = 20_000  # of a curve over a run: a day of one-second slots is drawn every five seconds

# For slots that share a pixel: the mean of their logarithms would be far below the logarithm of their mean.
LARGEST = rr.components.AggregationPolicy.Max


def times_of(scene: Scene) -> SlotTimes:
    """The time lines of a run."""
    return SlotTimes.of(scene.slots, scene.slot_seconds)


def recent_slots(scene: Scene) -> rrb.TimeAxis:
    """An axis that follows the newest slot."""
    times = times_of(scene)
    recent = rrb.TimeRange(start=times.after_cursor(-min(_WINDOW, scene.slots)), end=times.after_cursor(_ROOM))
    return rrb.TimeAxis(view_range=recent, zoom_lock=True)


def whole_run(scene: Scene) -> rrb.TimeAxis:
    """An axis from slot 0 to the last."""
    times = times_of(scene)
    first, last = 0, scene.slots
    if times.line == CLOCK:
        # Rerun writes a date at each midnight: the first is not cut at the border, and the last is left out.
        first, last = -scene.slots // _ROOM_FOR_DATE, scene.slots - scene.slots // _HIDDEN
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=times.at(first), end=times.at(last)), zoom_lock=True)


def time_series(title: str, axis: rrb.TimeAxis, **more: Any) -> rrb.TimeSeriesView:
    """A view of curves on a ground that is dark in both themes: most of their colours would be illegible on white.

    axis: horizontal; more: as of Rerun.
    """
    return rrb.TimeSeriesView(name=title, axis_x=axis, background=PlotBackground(color=GROUND), **more)


def receivers_view(title: str, contents: list[str], axis: rrb.TimeAxis, origin: str = "/") -> rrb.TimeSeriesView:
    """A view of curves in the receivers' colours, which the legend of the whole view explains."""
    return time_series(title, axis, origin=origin, contents=contents, plot_legend=rrb.PlotLegend(visible=False))


def curves_view(
    title: str, path: str, axis: rrb.TimeAxis, values: rrb.ScalarAxis | None = None, *, legend: bool = True
) -> rrb.TimeSeriesView:
    """A view of the curves below a path; axis: horizontal; values: the vertical axis, by default automatic.

    legend: whether it names its curves, which those of truth and receivers do not need.
    """
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return time_series(title, axis, origin=f"/{path}", axis_y=values, plot_legend=corner)


def line_style(label: str, bright: Colour, width: float, *, steps: bool = False) -> rr.SeriesLines:
    """The style of a curve; steps: each value holds until the next."""
    mode = rr.components.InterpolationMode.StepAfter if steps else rr.components.InterpolationMode.Linear
    return rr.SeriesLines(names=label, colors=bright, widths=width, interpolation_mode=mode)


def thinned(scene: Scene, slots: NDArray[np.int64]) -> NDArray[np.intp]:
    """The offsets of those slots at which a curve over the whole run is drawn."""
    return np.flatnonzero(slots % math.ceil(scene.slots / _MOST_POINTS) == 0)


def logarithms(scene: Scene, path: str, slots: NDArray[np.int64], values: Floats) -> Iterator[Column]:
    """The roots of squared errors or traces (c,) as units of a logarithmic axis, without NaNs.

    Roots have a unit, and half as many powers of ten. Smaller values are raised to the floor of `error_floor`: after a state was
    received, the error is 0.
    """
    covered = ~np.isnan(values)  # no theory covers some links
    if covered.any():
        floor = error_floor(scene.noise, scene.trials)
        yield scalars(path, slots[covered], np.log10(np.maximum(values[covered], floor)) / (2 * decades(scene)))


def decades(scene: Scene) -> int:
    """Powers of ten of a unit of a logarithmic axis.

    Rerun writes a number at each unit if it has 20 pixels, so a small panel has numbers for five units at most. Errors extend
    over two or three powers of ten, and those of an unstable process over as many more as an estimate without packets diverges.
    """
    return math.ceil((_USUAL + scene.growth) / _UNITS)


def powers_of_ten(scene: Scene) -> str:
    """What the numbers of a logarithmic axis stand for, such as "−1: 0.1 m · 1: 10 m", for the title of its view.

    Rerun writes only numbers on an axis.
    """
    units = [*dict.fromkeys(scene.units)]
    unit = f" {units[0]}" if len(units) == 1 else ""
    power = decades(scene)
    less, more = (f"{10.0**-power:.{power}f}", f"{10**power:,}") if power < _LONG else (f"1e-{power}", f"1e{power}")
    return f"−1: {less}{unit} · 1: {more}{unit}"


def _errors_style(label: str, colour: Colour, width: float, **more: Any) -> rr.SeriesLines:
    return rr.SeriesLines(names=label, colors=colour, widths=width, aggregation_policy=LARGEST, **more)


_ERROR_PATH, _BAND = "error", "band"
_NO_NAME = " "
"""The name of curves in the legend, which the receivers' own curves explain."""
_SIDES = ("low", "high")


@final
class SquaredError(ViewPanel):
    """The root of |x − x̂|² on a logarithmic scale: in recent slots, or in the whole run of a closed loop."""

    def views(self) -> Iterator[PlacedView]:
        """One view: of the whole run for a closed loop, otherwise of the recent slots."""
        title = f"Error   {'dim: 95 %   ' if self._with_bands else ''}{powers_of_ten(self.scene)}{self._mixture}"
        contents = [f"/{kind}/**" for kind in ([_ERROR_PATH, _BAND] if self._with_bands else [_ERROR_PATH])]
        if self.scene.moving:
            yield PlacedView(receivers_view(title, contents, whole_run(self.scene)), "right", 1.2)
        else:
            yield PlacedView(receivers_view(title, contents, recent_slots(self.scene)), "middle")

    @property
    def _mixture(self) -> str:
        """The units of the states if they have several, such as "   (m, m/s)"."""
        units = [*dict.fromkeys(self.scene.units)]
        return f"   ({', '.join(units)})" if len(units) > 1 else ""

    @property
    def _with_bands(self) -> bool:
        return self.scene.trials > 1

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each curve in its receiver's colour, and the edges of its band dim."""
        styles = {}
        for shown in self.scene.receivers:
            bright = self.scene.colours[shown.name]
            styles[f"{_ERROR_PATH}/{shown.name}"] = _errors_style(shown.name, bright, 1.5)
            for side in _SIDES if self._with_bands else ():
                styles[f"{_BAND}/{shown.name}/{side}"] = _errors_style(_NO_NAME, dim(bright), 1.0)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A curve for each receiver, and two for the edges of its band."""
        for shown in self.scene.receivers:
            peer = slots.peers[shown.name]
            yield from logarithms(self.scene, f"{_ERROR_PATH}/{shown.name}", slots.numbers, peer.squared_error)
            edges = zip(_SIDES, mean_band(peer.squared_error, peer.standard_error, self.scene.trials), strict=True)
            for side, edge in edges if self._with_bands else ():
                yield from logarithms(self.scene, f"{_BAND}/{shown.name}/{side}", slots.numbers, edge)


_REPORTED, _THEORY = "trace", "theory"


@final
class TraceOfP(ViewPanel):
    """The root of tr P on a logarithmic scale. Recorded but not shown for a closed loop."""

    def views(self) -> Iterator[PlacedView]:
        """One view, below the errors, or beside them where lanes leave little height."""
        if not self.scene.moving:
            title = f"Root of tr P   dim: theory   {powers_of_ten(self.scene)}"
            view = receivers_view(title, [f"/{_REPORTED}/**", f"/{_THEORY}/**"], recent_slots(self.scene))
            yield PlacedView(view, "left" if crowded(self.scene) else "middle")

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each receiver's colour: bright for its belief, dim for theory."""
        styles = {}
        for shown in self.scene.receivers:
            bright, label = self.scene.colours[shown.name], shown.name
            styles[f"{_REPORTED}/{label}"] = _errors_style(label, bright, 1.5, interpolation_mode="StepAfter")
            styles[f"{_THEORY}/{label}"] = _errors_style(f"{label}, theory", dim(bright), 1.0)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Two curves for each receiver; only the first if no theory covers it."""
        for shown in self.scene.receivers:
            peer = slots.peers[shown.name]
            yield from logarithms(self.scene, f"{_REPORTED}/{shown.name}", slots.numbers, peer.trace)
            yield from logarithms(self.scene, f"{_THEORY}/{shown.name}", slots.numbers, peer.theoretical_trace)


def worlds_over_time(scene: Scene, path: str, axis: rrb.TimeAxis) -> Iterator[PlacedView]:
    """The first state as it is, and as each receiver believes it: curves below a path, named as truth and receivers.

    What happens has marks where the state was attacked, which its legend explains. A drawing takes its place.
    """
    label = scene.states[0] if scene.states else "the state"

    def view(title: str, *names: str, legend: bool = False) -> rrb.TimeSeriesView:
        contents, corner = [f"{path}/{name}" for name in names], rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
        return time_series(title, axis, origin=path, contents=contents, plot_legend=corner)

    attacked = bool(lane_count(scene))
    if scene.drawing is None:
        yield PlacedView(view(f"{scene.what_happens}: {label}", TRUTH_NAME, f"{_ATTACKS}/**", legend=attacked), "truth")
    for shown in scene.receivers:
        yield PlacedView(view(f"{shown.world_title}   grey: {scene.compared_with}", TRUTH_NAME, shown.name), "worlds")


_ATTACKS = "Attacks"


@final
class AttackedCurve:
    """Marks on the curve of the first state where it is attacked, below a path."""

    def __init__(self, scene: Scene, path: str) -> None:
        self._attacks, self._path = Attacks(scene), f"{path}/{_ATTACKS}"

    def styles(self) -> dict[str, rr.SeriesPoints]:
        """A diamond in the colour of the attack."""
        return {
            f"{self._path}/{i}": rr.SeriesPoints(names=words, colors=bright, markers="diamond", marker_sizes=4.5)
            for i, (words, bright) in enumerate(self._attacks.kinds)
        }

    def columns(self, slots: SceneSlots, at: NDArray[np.intp]) -> Iterator[Column]:
        """The marks at some offsets of the slots."""
        for i, flags in enumerate(self._attacks.flags(slots)):
            attacked = at[flags[at]]
            if len(attacked):
                yield scalars(f"{self._path}/{i}", slots.numbers[attacked], slots.x[attacked, 0])


_STATE_PATH = "plane"


@final
class StateOverTime(ViewPanel):
    """The state and every estimate, in place of the state plane. Recorded but not shown for a closed loop."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._marks = AttackedCurve(scene, _STATE_PATH)

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for one state."""
        return scene.n == 1

    def views(self) -> Iterator[PlacedView]:
        """One view, on the right."""
        if not self.scene.moving:
            axis, contents = recent_slots(self.scene), ["$origin/**", f"- /{_STATE_PATH}/{_ATTACKS}/**"]
            yield PlacedView(receivers_view("State and estimates", contents, axis, _STATE_PATH), "right")
            yield from worlds_over_time(self.scene, _STATE_PATH, axis)

    def styles(self) -> dict[str, rr.AsComponents]:
        """Each estimate in its receiver's colour; the truth grey and wide."""
        styles: dict[str, rr.AsComponents] = {**self._marks.styles()}
        styles[f"{_STATE_PATH}/{TRUTH_NAME}"] = rr.SeriesLines(
            names=self.scene.compared_with, colors=TRUTH_CURVE, widths=2.5
        )
        for name, bright in self.scene.colours.items():
            styles[f"{_STATE_PATH}/{name}"] = rr.SeriesLines(names=name, colors=bright, widths=1.5)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The truth, every estimate, and the attacks."""
        yield from self._marks.columns(slots, np.arange(slots.count))
        yield scalars(f"{_STATE_PATH}/{TRUTH_NAME}", slots.numbers, slots.x[:, 0])
        for shown in self.scene.receivers:
            yield scalars(f"{_STATE_PATH}/{shown.name}", slots.numbers, slots.peers[shown.name].x_hat[:, 0])


_LEVELS_PATH = "levels"
_VIEWS = 2  # the first states have views; the others are recorded, but not shown


@final
class Levels(ViewPanel):
    """A view for each of the first states, over the whole run."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._marks = AttackedCurve(scene, f"{_LEVELS_PATH}/0")

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop."""
        return bool(scene.moving)

    def views(self) -> Iterator[PlacedView]:
        """A view for each of the first two states, in the middle."""
        for i in range(min(self.scene.n, _VIEWS)):
            label = self.scene.states[i] if self.scene.states else f"state {i}"
            title = f"{label}   grey: {self.scene.compared_with}"
            yield PlacedView(curves_view(title, f"{_LEVELS_PATH}/{i}", whole_run(self.scene), legend=False), "middle")
        yield from worlds_over_time(self.scene, f"{_LEVELS_PATH}/0", whole_run(self.scene))

    def styles(self) -> dict[str, rr.AsComponents]:
        """Each estimate in its receiver's colour; the truth grey and wide."""
        styles: dict[str, rr.AsComponents] = {**self._marks.styles()}
        for i in range(self.scene.n):
            styles[f"{_LEVELS_PATH}/{i}/{TRUTH_NAME}"] = line_style(self.scene.compared_with, TRUTH_CURVE, 1.8)
            for name, bright in self.scene.colours.items():
                styles[f"{_LEVELS_PATH}/{i}/{name}"] = line_style(name, bright, 0.9)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Every state, true and estimated, and the attacks."""
        at = thinned(self.scene, slots.numbers)
        if not len(at):
            return
        yield from self._marks.columns(slots, at)
        k = slots.numbers[at]
        for i in range(self.scene.n):
            yield scalars(f"{_LEVELS_PATH}/{i}/{TRUTH_NAME}", k, slots.x[at, i])
            for name, peer in slots.peers.items():
                yield scalars(f"{_LEVELS_PATH}/{i}/{name}", k, peer.x_hat[at, i])


_PLANT_PATH = "moving"


@final
class WhatMovesThePlant(ViewPanel):
    """Disturbances, and inputs as the plant's limits clip them, over the whole run."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop."""
        return bool(scene.moving)

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top of the left side."""
        title = "What moves the plant: " + ", ".join(self.scene.moving)
        yield PlacedView(curves_view(title, _PLANT_PATH, whole_run(self.scene)), "left", 1.3)

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Steps, because a value holds for its whole slot."""
        return {
            _curve(i): line_style(label, PLANT[i % len(PLANT)], 1.4, steps=True)
            for i, label in enumerate(self.scene.moving)
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A curve for each disturbance and input."""
        at = thinned(self.scene, slots.numbers)
        if slots.moved is not None and len(at):
            for i, values in enumerate(slots.moved.values.T):
                yield scalars(_curve(i), slots.numbers[at], values[at])


def _curve(i: int) -> str:
    return f"{_PLANT_PATH}/{i}"


@final
class ApplicationPanels(ViewPanel):
    """A view for each panel that an application describes, over the whole run."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop with an application that has panels."""
        return bool(scene.panels)

    def views(self) -> Iterator[PlacedView]:
        """Panels of the plant on the left, panels of the receivers' beliefs on the right."""
        for panel in self.scene.panels:
            span = None if panel.span is None else rrb.ScalarAxis(range=panel.span, zoom_lock=True)
            view = curves_view(panel.title, panel.path, whole_run(self.scene), span, legend=not panel.with_beliefs)
            yield PlacedView(view, "right", 0.9) if panel.with_beliefs else PlacedView(view, "left")

    def styles(self) -> dict[str, rr.SeriesLines | rr.SeriesPoints]:
        """The styles that the application describes; a receiver's own colour if it gives none."""
        styles: dict[str, rr.SeriesLines | rr.SeriesPoints] = {}
        for panel in self.scene.panels:
            for curve in panel.curves:
                bright, label = curve.colour or self.scene.colours[curve.name], curve.label or curve.name
                styles[f"{panel.path}/{curve.name}"] = (
                    rr.SeriesPoints(names=label, colors=bright, markers="circle", marker_sizes=curve.width)
                    if curve.drawn == "points"
                    else line_style(label, bright, curve.width, steps=curve.drawn == "steps")
                )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A column for every curve: lines are thinned, points are not."""
        if slots.moved is None:
            return
        for panel in self.scene.panels:
            for curve in panel.curves:
                path = f"{panel.path}/{curve.name}"
                numbers, values = slots.moved.curves[path]
                k = numbers.astype(np.int64)
                at = np.arange(len(k)) if curve.drawn == "points" else thinned(self.scene, k)
                if len(at):
                    yield scalars(path, k[at], values[at])
