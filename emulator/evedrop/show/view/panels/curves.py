"""Shared by panels with curves: axes, views, styles, logarithms."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.show.view.column import Column, scalars
from evedrop.show.view.error_floor import error_floor
from evedrop.show.view.palette import Colour
from evedrop.show.view.scene import Scene

_WINDOW = 105  # slots; below four pixels a slot, Rerun merges neighbouring slots into grey
_ROOM = 3  # slots to the right of the present, so that the newest slot is not at the border
_MOST_POINTS = 20_000  # of a curve over a run: a day of one-second slots is drawn every five seconds

# For slots that share a pixel: the mean of their logarithms would be far below the logarithm of their mean.
LARGEST = rr.components.AggregationPolicy.Max


def recent_slots(scene: Scene) -> rrb.TimeAxis:
    """An axis that follows the newest slot."""
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-min(_WINDOW, scene.slots)),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=_ROOM),
    )
    return rrb.TimeAxis(view_range=recent, zoom_lock=True)


def whole_run(scene: Scene) -> rrb.TimeAxis:
    """An axis from slot 0 to the last."""
    whole = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.absolute(seq=0), end=rrb.TimeRangeBoundary.absolute(seq=scene.slots)
    )
    return rrb.TimeAxis(view_range=whole, zoom_lock=True)


def receivers_view(title: str, kinds: list[str], axis: rrb.TimeAxis) -> rrb.TimeSeriesView:
    """A view of the curves below some paths, in the receivers' colours, which the legend of the whole view explains."""
    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=[f"/{kind}/**" for kind in kinds],
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )


def curves_view(
    title: str, path: str, axis: rrb.TimeAxis, values: rrb.ScalarAxis | None = None, *, legend: bool = True
) -> rrb.TimeSeriesView:
    """A view of the curves below a path; axis: horizontal; values: the vertical axis, by default automatic.

    legend: whether it names its curves, which those of truth and receivers do not need.
    """
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(name=title, origin=f"/{path}", axis_x=axis, axis_y=values, plot_legend=corner)


def line_style(label: str, bright: Colour, width: float, *, steps: bool = False) -> rr.SeriesLines:
    """The style of a curve; steps: each value holds until the next."""
    mode = rr.components.InterpolationMode.StepAfter if steps else rr.components.InterpolationMode.Linear
    return rr.SeriesLines(names=label, colors=bright, widths=width, interpolation_mode=mode)


def thinned(scene: Scene, slots: NDArray[np.int64]) -> NDArray[np.intp]:
    """The offsets of those slots at which a curve over the whole run is drawn."""
    return np.flatnonzero(slots % math.ceil(scene.slots / _MOST_POINTS) == 0)


def logarithms(scene: Scene, path: str, slots: NDArray[np.int64], values: Floats) -> Iterator[Column]:
    """log10 of squared errors or traces (c,), without NaNs.

    Smaller values are raised to the floor of `error_floor`: after a state was received, the error is 0.
    """
    covered = ~np.isnan(values)  # no theory covers some links
    if covered.any():
        floor = error_floor(scene.noise, scene.trials)
        yield scalars(path, slots[covered], np.log10(np.maximum(values[covered], floor)))
