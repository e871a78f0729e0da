"""The panel of the state and its estimates over time, for a process with one state."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.column import Column, scalars
from evedrop.show.view.palette import TRUTH_CURVE, colour
from evedrop.show.view.panels.curves import recent_slots
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import TRUTH, Scene, SceneSlots

_PATH = "plane"


@final
class StateOverTime(ViewPanel):
    """The state and every estimate, in place of the state plane. Recorded but not shown for a closed loop."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for one state."""
        return scene.n == 1

    def views(self) -> Iterator[PlacedView]:
        """One view, on the right."""
        if not self.scene.moving:
            view = rrb.TimeSeriesView(
                name="State and estimates",
                origin=_PATH,
                axis_x=recent_slots(self.scene),
                plot_legend=rrb.PlotLegend(visible=False),
            )
            yield PlacedView(view, "right")

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each estimate in its receiver's colour; the truth grey and wide."""
        styles = {f"{_PATH}/{TRUTH}": rr.SeriesLines(names="truth", colors=TRUTH_CURVE, widths=2.5)}
        for i, shown in enumerate(self.scene.receivers):
            styles[f"{_PATH}/{shown.name}"] = rr.SeriesLines(names=shown.name, colors=colour(i), widths=1.5)
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """The truth, and every estimate."""
        yield scalars(f"{_PATH}/{TRUTH}", slots.numbers, slots.x[:, 0])
        for shown in self.scene.receivers:
            yield scalars(f"{_PATH}/{shown.name}", slots.numbers, slots.peers[shown.name].x_hat[:, 0])
