"""The panel of the squared error of each receiver, mean over trials."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr

from evedrop.view.column import Column
from evedrop.view.palette import colour
from evedrop.view.panels.curves import LARGEST, logarithms, receivers_view, recent_slots, whole_run
from evedrop.view.panels.panel import PlacedView, ViewPanel
from evedrop.view.scene import SceneSlots

_PATH = "error"


@final
class SquaredError(ViewPanel):
    """|x − x̂|² on a logarithmic scale: in recent slots, or in the whole run of a closed loop."""

    def views(self) -> Iterator[PlacedView]:
        """One view, with the legend of receivers unless an application's panel above it has one."""
        title = "Squared error |x − x̂|²   log10"
        if self.scene.moving:
            legend = not any(panel.with_beliefs for panel in self.scene.panels)
            yield PlacedView(receivers_view(title, [_PATH], whole_run(self.scene), legend=legend), "right")
        else:
            title += ", bottom: exact"
            yield PlacedView(receivers_view(title, [_PATH], recent_slots(self.scene), legend=True), "left")

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each curve in its receiver's colour."""
        return {
            f"{_PATH}/{shown.name}": rr.SeriesLines(
                names=shown.name, colors=colour(i), widths=1.5, aggregation_policy=LARGEST
            )
            for i, shown in enumerate(self.scene.receivers)
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A curve for each receiver."""
        for shown in self.scene.receivers:
            error = slots.peers[shown.name].squared_error
            yield from logarithms(self.scene, f"{_PATH}/{shown.name}", slots.numbers, error)
