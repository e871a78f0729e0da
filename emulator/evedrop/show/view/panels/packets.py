"""The panel of packets: a lane for the sensor, which shows their types, and one for each receiver, which shows their fates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view import lanes
from evedrop.show.view.column import Column
from evedrop.show.view.panels.curves import recent_slots
from evedrop.show.view.panels.heights import FIXED_HEIGHT, crowded, lanes_height
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.panels.state_lanes import StateLanes
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "packets"


@final
class Packets(ViewPanel):
    """The lanes of sensor and receivers."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        names = ["sent", *(shown.name for shown in scene.receivers)]
        shown_lanes = [lanes.SENT, *(lanes.lane_of(shown) for shown in scene.receivers)]
        self._lanes = StateLanes(_PATH, zip(names, shown_lanes, strict=True), first=0)

    def views(self) -> Iterator[PlacedView]:
        """One view, as high as the lanes need: above the events, or, with many receivers or a closed loop, at the top."""
        view = rrb.StateTimelineView(name="Packets", origin=_PATH, time_view=recent_slots(self.scene))
        receivers = len(self.scene.receivers)
        height = lanes_height(receivers + 1)
        if self.scene.moving or crowded(self.scene):
            yield PlacedView(view, "top", height=height)
        else:
            column = 1.0 - FIXED_HEIGHT - lanes_height(receivers)
            yield PlacedView(view, "left", height / (column - height))

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """Colours; the legend says what they mean."""
        return self._lanes.styles()

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        lanes_of = [lanes.sent(slots), *(lanes.received(shown, slots) for shown in self.scene.receivers)]
        for path, at, words in self._lanes.changes(lanes_of):
            yield Column(path, slots.numbers[at], words)
