"""The strip at the top: who knows what."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.show.view.column import Column
from evedrop.show.view.knowledge import ErrorDistance, knowledge
from evedrop.show.view.panels.curves import recent_slots
from evedrop.show.view.panels.heights import lanes_height
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.panels.state_lanes import StateLanes
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "knows"


@final
class WhoKnowsWhat(ViewPanel):
    """A lane for each receiver: in track, drifting or fooled, with its error in words."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._distances = {shown.name: ErrorDistance(scene) for shown in scene.receivers}
        named = [(name, distance.lane) for name, distance in self._distances.items()]
        self._lanes = StateLanes(_PATH, named, first=1, labelled=True)

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top."""
        view = rrb.StateTimelineView(name="Who knows what", origin=_PATH, time_view=recent_slots(self.scene))
        yield PlacedView(view, "top", 1.2, lanes_height(len(self.scene.receivers)))

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """Words and colours."""
        return self._lanes.styles()

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        codes = (self._codes(shown.name, slots) for shown in self.scene.receivers)
        for path, at, words in self._lanes.changes(codes):
            yield Column(path, slots.numbers[at], words)

    def _codes(self, name: str, slots: SceneSlots) -> NDArray[np.int64]:
        peer, distance = slots.peers[name], self._distances[name]
        return distance.codes(knowledge(self.scene, slots.x, peer), distance.of(slots.x, peer.x_hat))
