"""The strip at the top: who knows what."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from evedrop.view.column import Column
from evedrop.view.knowledge import ErrorDistance, knowledge
from evedrop.view.panels.curves import recent_slots
from evedrop.view.panels.heights import lanes_height
from evedrop.view.panels.panel import PlacedView, ViewPanel
from evedrop.view.scene import Scene, SceneSlots

_PATH = "knows"


@final
class WhoKnowsWhat(ViewPanel):
    """A lane for each receiver: in track, drifting or fooled, with its error in words; only changes are recorded."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        digits = len(str(len(scene.receivers)))
        self._paths = [f"{_PATH}/{i + 1:0{digits}d}_{shown.name}" for i, shown in enumerate(scene.receivers)]
        self._distances = [ErrorDistance(scene) for _ in self._paths]
        self._words = ErrorDistance(scene).words
        self._last = [-1] * len(self._paths)

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top."""
        view = rrb.StateTimelineView(name="Who knows what", origin=_PATH, time_view=recent_slots(self.scene))
        yield PlacedView(view, "top", 1.2, lanes_height(len(self._paths)))

    def styles(self) -> dict[str, rr.StateConfiguration]:
        """Words and colours."""
        colours = [one.colour for one in ErrorDistance(self.scene).meanings]
        return {path: rr.StateConfiguration(values=self._words, colors=colours) for path in self._paths}

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The lanes' changes."""
        for i, (path, distance) in enumerate(zip(self._paths, self._distances, strict=True)):
            peer = slots.peers[self.scene.receivers[i].name]
            codes = distance.codes(knowledge(self.scene, slots.x, peer), distance.of(slots.x, peer.x_hat))
            at = np.flatnonzero(np.diff(codes, prepend=self._last[i]))
            self._last[i] = int(codes[-1])
            if len(at):
                words = [self._words[code] for code in codes[at].tolist()]
                yield Column(path, slots.numbers[at], rr.StateChange.columns(state=words))
