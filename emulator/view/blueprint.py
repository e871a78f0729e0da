"""The layout of the view: curves and lanes on the left, the state plane and the events on the right."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from emulator.view import lanes, paths, plane
from emulator.view.palette import GROUND, colour_name
from emulator.view.scene import Scene

_WINDOW = 130  # slots; in a longer one a slot is below four pixels, and Rerun merges it with its neighbours to grey
_TRAIL = 45
_TRUTH_TRAIL = 130


def layout(scene: Scene) -> rrb.Blueprint:
    """The panels of a run."""
    left = rrb.Vertical(
        _curves("Squared error |x − x̂|²   (log10)", scene, [paths.ERROR]),
        _curves("tr P believed, dim: theory   (log10)", scene, [paths.TRACE, paths.THEORY]),
        rrb.StateTimelineView(name=f"Packets   {lanes.LEGEND}", origin=paths.PACKETS, time_view=_axis(scene)),
        row_shares=[1.0, 1.0, 0.9],
    )
    right = rrb.Vertical(_plane(scene), _events(), row_shares=[1.75, 1.0])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.35, 1.0]),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=paths.TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _curves(title: str, scene: Scene, kinds: list[str]) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=[f"/{kind}/**" for kind in kinds],
        axis_x=_axis(scene),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def _axis(scene: Scene) -> rrb.TimeAxis:
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-min(_WINDOW, scene.slots)),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=2),
    )
    return rrb.TimeAxis(view_range=recent, zoom_lock=True)


def _plane(scene: Scene) -> rrb.View:
    if scene.n == 1:
        return rrb.TimeSeriesView(
            name="State",
            origin=paths.PLANE,
            axis_x=_axis(scene),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )
    colours = " · ".join(f"{colour_name(i)}: {shown.name}" for i, shown in enumerate(scene.receivers))
    trails: dict[str, rrb.VisibleTimeRanges] = {
        paths.trail(shown.name): _past(scene, _TRAIL) for shown in scene.receivers
    }
    trails[paths.trail(paths.TRUTH)] = _past(scene, _TRUTH_TRAIL)
    return rrb.Spatial2DView(
        name=f"States 1, 2   white: truth · {colours} · ellipses: 2σ believed",
        origin=paths.PLANE,
        background=list(GROUND),
        overrides=trails,  # type: ignore[arg-type]
    )


def _past(scene: Scene, slots: int) -> rrb.VisibleTimeRanges:
    # A trail's piece is logged at its end, so the oldest that is shown begins a frame earlier.
    reach = max(slots, 4 * plane.stride(scene))
    return rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                paths.TIMELINE,
                start=rrb.TimeRangeBoundary.cursor_relative(seq=-reach),
                end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
            )
        ]
    )


def _events() -> rrb.TextLogView:
    return rrb.TextLogView(
        name="Events",
        origin=paths.EVENTS,
        columns=rrb.TextLogColumns(
            timeline_columns=[TimelineColumn(paths.TIMELINE)],
            text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
        ),
        format_options=rrb.TextLogFormat(monospace_body=True),
    )
