"""The panel of tr P: of the covariance that each receiver believes, and of the one that theory expects of its error."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr

from evedrop.show.view.column import Column
from evedrop.show.view.palette import colour, dim
from evedrop.show.view.panels.curves import LARGEST, logarithms, receivers_view, recent_slots
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import SceneSlots

_BELIEVED, _THEORY = "trace", "theory"


@final
class TraceOfP(ViewPanel):
    """tr P on a logarithmic scale. Recorded but not shown for a closed loop."""

    def views(self) -> Iterator[PlacedView]:
        """One view, below the squared error."""
        if not self.scene.moving:
            title = "tr P   log10, dim: theory"
            yield PlacedView(receivers_view(title, [_BELIEVED, _THEORY], recent_slots(self.scene)), "middle")

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each receiver's colour: bright for its belief, dim for theory."""
        styles = {}
        for i, shown in enumerate(self.scene.receivers):
            bright, label = colour(i), shown.name
            styles[f"{_BELIEVED}/{label}"] = rr.SeriesLines(
                names=label, colors=bright, widths=1.5, interpolation_mode="StepAfter", aggregation_policy=LARGEST
            )
            styles[f"{_THEORY}/{label}"] = rr.SeriesLines(
                names=f"{label}, theory", colors=dim(bright, 0.6), widths=1.0, aggregation_policy=LARGEST
            )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Two curves for each receiver; only the first if no theory covers it."""
        for shown in self.scene.receivers:
            peer = slots.peers[shown.name]
            yield from logarithms(self.scene, f"{_BELIEVED}/{shown.name}", slots.numbers, peer.trace)
            yield from logarithms(self.scene, f"{_THEORY}/{shown.name}", slots.numbers, peer.expected_trace)
