"""The panel of the squared error of each receiver, mean over trials, with the band of its standard error."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr

from evedrop.show.view.column import Column
from evedrop.show.view.palette import colour, dim
from evedrop.show.view.panels.curves import LARGEST, logarithms, receivers_view, recent_slots, whole_run
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import SceneSlots

_PATH, _BAND = "error", "band"
_NO_NAME = " "
"""The name of curves in the legend, which the receivers' own curves explain."""
_SIDES = {"low": -1.96, "high": 1.96}
"""The edges of the band, in standard errors from the mean: 19 of 20 bands contain the expectation."""


@final
class SquaredError(ViewPanel):
    """|x − x̂|² on a logarithmic scale: in recent slots, or in the whole run of a closed loop."""

    def views(self) -> Iterator[PlacedView]:
        """One view: of the whole run for a closed loop, otherwise of the recent slots."""
        title = "Squared error   log10"
        if self.scene.moving:
            yield PlacedView(receivers_view(title, self._paths, whole_run(self.scene)), "right")
        else:
            title += ", dim: 95 % bands" if self._with_bands else ""
            yield PlacedView(receivers_view(title, self._paths, recent_slots(self.scene)), "middle")

    @property
    def _with_bands(self) -> bool:
        return self.scene.trials > 1

    @property
    def _paths(self) -> list[str]:
        return [_PATH, _BAND] if self._with_bands else [_PATH]

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Each curve in its receiver's colour, and the edges of its band dim."""
        styles = {}
        for i, shown in enumerate(self.scene.receivers):
            styles[f"{_PATH}/{shown.name}"] = rr.SeriesLines(
                names=shown.name, colors=colour(i), widths=1.5, aggregation_policy=LARGEST
            )
            for side in _SIDES if self._with_bands else ():
                styles[f"{_BAND}/{shown.name}/{side}"] = rr.SeriesLines(
                    names=_NO_NAME, colors=dim(colour(i), 0.5), widths=1.0, aggregation_policy=LARGEST
                )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A curve for each receiver, and two for the edges of its band."""
        for shown in self.scene.receivers:
            peer = slots.peers[shown.name]
            yield from logarithms(self.scene, f"{_PATH}/{shown.name}", slots.numbers, peer.squared_error)
            for side, distance in _SIDES.items() if self._with_bands else ():
                edge = peer.squared_error + distance * peer.standard_error
                yield from logarithms(self.scene, f"{_BAND}/{shown.name}/{side}", slots.numbers, edge)
