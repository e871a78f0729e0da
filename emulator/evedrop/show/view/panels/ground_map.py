"""The map of sender and receivers, for links whose losses depend on distance.

It is drawn by Evedrop: Rerun's own map would load its tiles from another host.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.model.links.way import Way
from evedrop.show.view.column import Column
from evedrop.show.view.palette import GROUND, TRUTH, colour, dim
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.panels.state_plane import frames
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "map"
_FLATTEST = 0.35  # height of the map section shown, compared with its width
_ROOM = 0.75  # from the middle to each side, so that labels fit


@final
class GroundMap(ViewPanel):
    """Where sender and receivers are, and how far apart, drawn at the view's frames."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only with a link whose losses depend on distance; not for a closed loop, whose view is full."""
        return bool(scene.ways) and not scene.moving

    def views(self) -> Iterator[PlacedView]:
        """One view, on the right."""
        corners = np.concatenate([self._corners(way) for ways in self.scene.ways.values() for way in ways])
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, size = (low + high) / 2, np.maximum(high - low, _FLATTEST * (high - low).max() + 1.0)
        x, y = ((float(m - _ROOM * s), float(m + _ROOM * s)) for m, s in zip(middle, size, strict=True))
        bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
        view = rrb.Spatial2DView(name="Map", origin=_PATH, background=list(GROUND), visual_bounds=bounds)
        yield PlacedView(view, "right", 0.6)

    def styles(self) -> dict[str, rr.AsComponents]:
        """The ways of the whole run as lines; receivers in their colours, senders white."""
        styles: dict[str, rr.AsComponents] = {}
        size = rr.Radius.ui_points
        for i, shown in enumerate(self.scene.receivers):
            if shown.name in self.scene.ways:
                ways = [self._corners(way) for way in self.scene.ways[shown.name]]
                lines = rr.LineStrips2D(ways, colors=[dim(TRUTH, 0.45), dim(colour(i), 0.55)], radii=size(1.0))
                styles[f"{_PATH}/{shown.name}/ways"] = lines
                styles[f"{_PATH}/{shown.name}/link"] = rr.LineStrips2D.from_fields(colors=[colour(i)], radii=size(0.7))
                styles[f"{_PATH}/{shown.name}/at"] = rr.Points2D.from_fields(
                    colors=[TRUTH, colour(i)], radii=size(5.0), show_labels=True
                )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Both ends of each link, and their distance in metres."""
        at = frames(self.scene, slots.first, slots.count)
        if not len(at):
            return
        k = slots.numbers[at]
        for name, ways in self.scene.ways.items():
            ends = np.stack([_on_map(way, k.astype(np.float64)) for way in ways], axis=1)
            distances = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
            labels = [text for distance in distances.tolist() for text in ("sensor", f"{name}: {distance:,.0f} m away")]
            yield Column(f"{_PATH}/{name}/link", k, rr.LineStrips2D.columns(strips=ends))
            points = rr.Points2D.columns(positions=ends.reshape(-1, 2), labels=labels)
            yield Column(f"{_PATH}/{name}/at", k, points.partition([2] * len(k)))

    def _corners(self, way: Way) -> NDArray[np.float32]:
        """The places of a run at which a way may change its direction, its first and its last one, (corners, 2)."""
        last = self.scene.slots - 1
        return _on_map(way, np.array(sorted({0, last, *(slot for slot in way.slots if slot < last)}), np.float64))


def _on_map(way: Way, slots: NDArray[np.float64]) -> NDArray[np.float32]:
    """Positions in slots, (c, 2); Rerun's y axis points down."""
    x, y = way.at(slots)
    return np.stack([x, -y], axis=1).astype(np.float32)
