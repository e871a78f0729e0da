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
from evedrop.view.column import TIMELINE, Column
from evedrop.view.events import Event
from evedrop.view.panels import PANELS
from evedrop.view.panels.panel import PlacedView, ViewPanel
from evedrop.view.scene import Scene, SceneSlots

T = TypeVar("T")


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
        """The views of all panels on two sides."""
        placed = [
            one
            for name, panel in [*self._panels.items()]
            for one in self._tried(name, partial(_views, panel, _drawable if PANELS.foreign(name) else _placed))
        ]
        sides = []
        for side in ("left", "right"):
            here = [one for one in placed if one.side == side]
            sides.append(rrb.Vertical(*(one.view for one in here), row_shares=[one.share for one in here]))
        return rrb.Blueprint(
            rrb.Horizontal(*sides, column_shares=[1.2 if self._scene.moving else 1.35, 1.0]),
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
        return [one for name, panel in [*self._panels.items()] for one in self._tried(name, partial(ask, panel))]

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


def _views(panel: ViewPanel, check: Callable[[PlacedView], PlacedView]) -> list[PlacedView]:
    return [check(one) for one in panel.views()]


def _placed(one: PlacedView) -> PlacedView:
    """The same view, if a layout can contain it. Raises an error otherwise."""
    if not isinstance(one, PlacedView) or one.side not in {"left", "right"} or not one.share > 0.0:
        raise TypeError(f"views() gave {one!r}; expected a PlacedView, left or right, with a share above 0")
    return one


def _drawable(one: PlacedView) -> PlacedView:
    """The same, and Rerun can draw it. Rerun keeps some threads for each view that is tried like this."""
    create_in_memory_blueprint(
        application_id="view", blueprint=rrb.Blueprint(_placed(one).view)
    ).storage.drain_as_bytes()
    return one


def _style(styles: Mapping[str, rr.AsComponents], to: rr.RecordingStream) -> tuple[()]:
    for path, style in styles.items():
        to.log(path, style, static=True, strict=True)
    return ()


def _send(columns: Iterable[Column], to: rr.RecordingStream) -> tuple[()]:
    for column in columns:
        column.send(to)
    return ()
