"""The layout of the view: curves and lanes on the left, the state plane and the events on the right."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from evedrop.view import driven, lanes, paths, plane
from evedrop.view.palette import GROUND
from evedrop.view.scene import Scene

_WINDOW = 105  # slots; with a slot below four pixels, Rerun merges it with its neighbours to grey
_LANES_OF_A_SCREEN = 23.0  # lanes that would fill the usual window from top to bottom
_ROOM = 25  # slots to the right of the present, kept free for the legend
_TRAIL = 30
_TRUTH_TRAIL = 130


def layout(scene: Scene) -> rrb.Blueprint:
    """The panels of a run."""
    if scene.moving:
        return _blueprint(_driven(scene))
    left = rrb.Vertical(
        _curves("Squared error |x − x̂|²   log10, bottom: exact", [paths.ERROR], _axis(scene), legend=True),
        _curves(
            "tr P   log10, bright: believed · dim: theory · bottom: 0",
            [paths.TRACE, paths.THEORY],
            _axis(scene),
            legend=False,
        ),
        rrb.StateTimelineView(name=f"Packets   {lanes.LEGEND}", origin=paths.PACKETS, time_view=_axis(scene)),
        row_shares=_left_shares(scene),
    )
    right = rrb.Vertical(_plane(scene), _events(), row_shares=[1.75, 1.0])
    return _blueprint(rrb.Horizontal(left, right, column_shares=[1.35, 1.0]))


def _driven(scene: Scene) -> rrb.Container:
    """The panels of a closed loop: plant and levels on the left, over the whole run; network and events on the right."""
    whole = rrb.TimeAxis(
        view_range=rrb.TimeRange(
            start=rrb.TimeRangeBoundary.absolute(seq=0), end=rrb.TimeRangeBoundary.absolute(seq=scene.slots)
        ),
        zoom_lock=True,
    )
    found, beliefs = driven.panels(scene, whole), driven.beliefs(scene, whole)
    left = rrb.Vertical(*found, row_shares=[1.3, *[1.0] * (len(found) - 1)])
    right = rrb.Vertical(
        *beliefs,
        _curves("Squared error |x − x̂|²   log10", [paths.ERROR], whole, legend=not beliefs),
        rrb.StateTimelineView(name=f"Packets   {lanes.LEGEND}", origin=paths.PACKETS, time_view=_axis(scene)),
        _events(),
        row_shares=[*[1.2] * len(beliefs), 1.0, 0.4 + 0.22 * len(scene.receivers), 0.7],
    )
    return rrb.Horizontal(left, right, column_shares=[1.2, 1.0])


def _blueprint(root: rrb.Container) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=paths.TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _left_shares(scene: Scene) -> list[float]:
    """Heights on the left: the lanes get what they need, at most half; the curves share the rest equally."""
    lanes_share = min(0.5, (2.0 + len(scene.receivers) + 1) / _LANES_OF_A_SCREEN)
    return [0.5 - lanes_share / 2, 0.5 - lanes_share / 2, lanes_share]


def _curves(title: str, kinds: list[str], axis: rrb.TimeAxis, *, legend: bool) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=[f"/{kind}/**" for kind in kinds],
        axis_x=axis,
        # One legend serves all panels: a receiver has the same colour in each.
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
    )


def _axis(scene: Scene) -> rrb.TimeAxis:
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-min(_WINDOW, scene.slots)),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=_ROOM),
    )
    return rrb.TimeAxis(view_range=recent, zoom_lock=True)


def _plane(scene: Scene) -> rrb.View:
    if scene.n == 1:
        return rrb.TimeSeriesView(
            name="State and estimates",
            origin=paths.PLANE,
            axis_x=_axis(scene),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        )
    trails: dict[str, rrb.VisibleTimeRanges] = {
        paths.trail(shown.name): _past(scene, _TRAIL) for shown in scene.receivers
    }
    trails[paths.trail(paths.TRUTH)] = _past(scene, _TRUTH_TRAIL)
    return rrb.Spatial2DView(
        name="State plane   white: truth · others coloured as their curves · ellipses: 2σ believed",
        origin=paths.PLANE,
        background=list(GROUND),
        overrides=trails,  # type: ignore[arg-type]
    )


def _past(scene: Scene, slots: int) -> rrb.VisibleTimeRanges:
    # A trail's piece is logged at its end, so the oldest piece shown begins a frame earlier.
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
