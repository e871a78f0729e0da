"""The panel of packets: a lane for the sensor, which shows their types, and one for each receiver, which shows their fates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from evedrop.view import lanes
from evedrop.view.column import Column
from evedrop.view.panels.curves import recent_slots
from evedrop.view.panels.heights import FIXED_HEIGHT, crowded, lanes_height
from evedrop.view.panels.panel import PlacedView, ViewPanel
from evedrop.view.scene import Scene, SceneSlots

_PATH = "packets"


@final
class Packets(ViewPanel):
    """The lanes of sensor and receivers; only changes are recorded."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        # Lanes are sorted by path, hence the number.
        digits = len(str(len(scene.receivers)))
        names = ["sent", *(shown.name for shown in scene.receivers)]
        self._paths = [f"{_PATH}/{i:0{digits}d}_{name}" for i, name in enumerate(names)]
        self._lanes = [lanes.SENT, *(lanes.lane_of(shown) for shown in scene.receivers)]
        self._last = [-1] * len(names)

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
        """Blank labels: a slot is too narrow for a word, and the legend says what the colours mean."""
        return {
            path: rr.StateConfiguration(values=lane.words, labels=[" "] * len(lane.words), colors=lane.colours)
            for path, lane in zip(self._paths, self._lanes, strict=True)
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        found = [lanes.sent(slots), *(lanes.received(shown, slots) for shown in self.scene.receivers)]
        for i, (path, lane, codes) in enumerate(zip(self._paths, self._lanes, found, strict=True)):
            at = np.flatnonzero(np.diff(codes.astype(np.int64), prepend=self._last[i]))
            self._last[i] = int(codes[-1])
            if len(at):
                words = [lane.words[code] for code in codes[at].tolist()]
                yield Column(path, slots.numbers[at], rr.StateChange.columns(state=words))
