"""The panel of events: those of the scenario and the operator, and long stretches without a usable packet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from evedrop.show.view.column import TIMELINE, Column
from evedrop.show.view.events import Event, Watcher
from evedrop.show.view.lanes import received
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "events"
_RUN = "run"


@final
class Events(ViewPanel):
    """A line for each event, with its slot and level."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._watchers = [(shown, Watcher(shown, scene)) for shown in scene.receivers]

    def views(self) -> Iterator[PlacedView]:
        """One view: below the packets, or at the bottom right for a closed loop."""
        view = rrb.TextLogView(
            name="Events",
            origin=_PATH,
            columns=rrb.TextLogColumns(
                timeline_columns=[TimelineColumn(TIMELINE)],
                text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
            ),
            format_options=rrb.TextLogFormat(monospace_body=True),
        )
        if self.scene.moving:
            yield PlacedView(view, "right", 0.7)
        else:
            yield PlacedView(view, "left")

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The events that the watcher of each receiver noticed."""
        for shown, watcher in self._watchers:
            yield from _lines(shown.name, watcher.watch(slots.first, received(shown, slots)))

    def notes(self, notes: Sequence[Event]) -> Iterator[Column]:
        """A line for each note."""
        yield from _lines(_RUN, notes)


def _lines(name: str, events: Sequence[Event]) -> Iterator[Column]:
    """Lines about a receiver or the run."""
    if events:
        k = np.array([event.k for event in events], np.int64)
        texts, levels = [event.text for event in events], [event.level for event in events]
        yield Column(f"{_PATH}/{name}", k, rr.TextLog.columns(text=texts, level=levels))
