"""The panels of a closed loop's states: the truth, and every receiver's estimate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr

from evedrop.show.view.column import Column, scalars
from evedrop.show.view.palette import TRUTH_CURVE, colour
from evedrop.show.view.panels.curves import curves_view, line_style, thinned, whole_run
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import TRUTH, Scene, SceneSlots

_PATH = "levels"
_VIEWS = 2  # the first states have views; the others are recorded, but not shown


@final
class Levels(ViewPanel):
    """A view for each of the first states, over the whole run."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop."""
        return bool(scene.moving)

    def views(self) -> Iterator[PlacedView]:
        """A view for each of the first two states, on the left side."""
        for i in range(min(self.scene.n, _VIEWS)):
            label = self.scene.states[i] if self.scene.states else f"state {i}"
            title = f"{label}   grey: truth"
            yield PlacedView(curves_view(title, f"{_PATH}/{i}", whole_run(self.scene), legend=False), "left")

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each estimate in its receiver's colour; the truth grey and wide."""
        styles = {}
        for i in range(self.scene.n):
            styles[f"{_PATH}/{i}/{TRUTH}"] = line_style("truth", TRUTH_CURVE, 1.8)
            for j, shown in enumerate(self.scene.receivers):
                styles[f"{_PATH}/{i}/{shown.name}"] = line_style(shown.name, colour(j), 0.9)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Every state, true and estimated."""
        at = thinned(self.scene, slots.numbers)
        if not len(at):
            return
        k = slots.numbers[at]
        for i in range(self.scene.n):
            yield scalars(f"{_PATH}/{i}/{TRUTH}", k, slots.x[at, i])
            for name, peer in slots.peers.items():
                yield scalars(f"{_PATH}/{i}/{name}", k, peer.x_hat[at, i])
