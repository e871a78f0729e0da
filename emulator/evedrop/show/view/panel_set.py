"""The panels of one recording: chooses them, lays them out and records their values.

A package's panel may be broken. It is then left out, with one warning, and harms neither the run nor the other panels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TypeVar, final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import create_in_memory_blueprint

from evedrop.errors import NotRegistered
from evedrop.model.registry import place_of
from evedrop.scenario.words import listed
from evedrop.show.view.column import TIMELINE, Column
from evedrop.show.view.events import Event
from evedrop.show.view.panels import PANELS
from evedrop.show.view.panels.panel import COLUMNS, ROWS_ABOVE, ROWS_BELOW, PlacedView, ViewPanel
from evedrop.show.view.scene import Scene, SceneSlots

T = TypeVar("T")

_WIDTHS = (1.2, 1.0, 1.0)  # of the columns, from the left; packets are on the left, and need four pixels for each slot
_LEAST_REST = 0.3  # of the height, for the columns, however many receivers there are
_LEAST_ROW = 0.05


@final
class PanelSet:
    """The panels that apply to a scene; those of packages come last. warn: called with a line for each one left out."""

    def __init__(self, scene: Scene, warn: Callable[[str], None]) -> None:
        self._scene, self._warn = scene, warn
        self._panels: dict[str, ViewPanel] = {}
        for name in (*PANELS, *filter(PANELS.foreign, PANELS.names)):
            for panel in self._tried(name, partial(self._made, name)):
                self._panels[name] = panel

    def _made(self, name: str) -> list[ViewPanel]:
        panel = PANELS[name]
        return [panel(self._scene)] if panel.applies(self._scene) else []

    def layout(self) -> rrb.Blueprint:
        """The views of all panels: rows over the whole width, and columns between them."""
        placed = [
            view
            for name, panel in [*self._panels.items()]
            for view in self._tried(name, partial(_views, panel, _drawable if PANELS.foreign(name) else _placed))
        ]
        return rrb.Blueprint(
            _arranged(placed),
            rrb.TopPanel(state="hidden"),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
            auto_views=False,
            auto_layout=False,
        )

    def send_styles(self, to: rr.RecordingStream) -> None:
        """Record every panel's styles."""
        self._each(lambda panel: _style(panel.styles(), to))

    def send(self, slots: SceneSlots, to: rr.RecordingStream) -> None:
        """Record the next slots."""
        self._each(lambda panel: _send(panel.columns(slots), to))

    def send_notes(self, notes: Sequence[Event], to: rr.RecordingStream) -> None:
        """Record lines about the run."""
        self._each(lambda panel: _send(panel.notes(notes), to))

    def _each(self, ask: Callable[[ViewPanel], Sequence[T]]) -> list[T]:
        return [answer for name, panel in [*self._panels.items()] for answer in self._tried(name, partial(ask, panel))]

    def _tried(self, name: str, ask: Callable[[], Sequence[T]]) -> Sequence[T]:
        """A panel's answer; empty if it fails: a package's panel is then left out from now on, and a built-in one raises."""
        try:
            return ask()
        except (Exception, SystemExit) as error:
            if not PANELS.foreign(name):
                raise
            self._panels.pop(name, None)
            why = error.why if isinstance(error, NotRegistered) else f": {place_of(error)}"
            self._warn(f"the view lacks the panel {name}{why}")
            return ()


def _arranged(placed: Sequence[PlacedView]) -> rrb.Container:
    """Rows above, columns, and rows below; each takes the share of the height that its views need, and columns the rest."""
    sides = {side: [view for view in placed if view.side == side] for side in (*ROWS_ABOVE, *COLUMNS, *ROWS_BELOW)}
    columns = [
        (rrb.Vertical(*(view.view for view in sides[side]), row_shares=[view.share for view in sides[side]]), width)
        for side, width in zip(COLUMNS, _WIDTHS, strict=True)
        if sides[side]
    ]
    heights = {side: max((view.height for view in sides[side]), default=0.0) for side in (*ROWS_ABOVE, *ROWS_BELOW)}
    rest = max(_LEAST_REST, 1.0 - sum(heights.values()))
    rows: list[tuple[rrb.Container, float]] = []
    for side in (*ROWS_ABOVE, None, *ROWS_BELOW):
        if side is None:
            rows.append(
                (rrb.Horizontal(*(view for view, _ in columns), column_shares=[width for _, width in columns]), rest)
            )
        elif sides[side]:
            row = rrb.Horizontal(
                *(view.view for view in sides[side]), column_shares=[view.share for view in sides[side]]
            )
            rows.append((row, max(heights[side], _LEAST_ROW)))
    return rrb.Vertical(*(row for row, _ in rows), row_shares=[share for _, share in rows])


def _views(panel: ViewPanel, check: Callable[[PlacedView], PlacedView]) -> list[PlacedView]:
    return [check(view) for view in panel.views()]


def _placed(view: PlacedView) -> PlacedView:
    """The same view, if a layout can contain it. Raises an error otherwise."""
    sides = (*ROWS_ABOVE, *COLUMNS, *ROWS_BELOW)
    if (
        not isinstance(view, PlacedView)
        or view.side not in sides
        or not view.share > 0.0
        or not 0.0 <= view.height < 1.0
    ):
        raise TypeError(
            f"views() gave {view!r}; expected a PlacedView, {listed(sides)}, with a share above 0 and a height below 1"
        )
    return view


def _drawable(view: PlacedView) -> PlacedView:
    """The same, and Rerun can draw it. Rerun keeps some threads for each view that is tried like this."""
    create_in_memory_blueprint(
        application_id="view", blueprint=rrb.Blueprint(_placed(view).view)
    ).storage.drain_as_bytes()
    return view


def _style(styles: Mapping[str, rr.AsComponents], to: rr.RecordingStream) -> tuple[()]:
    for path, style in styles.items():
        to.log(path, style, static=True, strict=True)
    return ()


def _send(columns: Iterable[Column], to: rr.RecordingStream) -> tuple[()]:
    for column in columns:
        column.send(to)
    return ()
