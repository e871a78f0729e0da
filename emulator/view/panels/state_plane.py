"""The panel of the first two states: the truth and every estimate with its recent path, and the covariance ellipses believed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.view import plane
from evedrop.view.column import TIMELINE, Column
from evedrop.view.palette import GROUND, Colour, colour, dim
from evedrop.view.palette import TRUTH as WHITE
from evedrop.view.panels.panel import PlacedView, ViewPanel
from evedrop.view.scene import TRUTH, Scene, SceneSlots

_PATH = "plane"
_FRAME = f"{_PATH}/frame"
_TRAIL = 30
_TRUTH_TRAIL = 130


@final
class StatePlane(ViewPanel):
    """The plane of the first two states, recorded only at the view's frames. Recorded but not shown for a closed loop."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._frame, every = plane.Frame(), plane.stride(scene)
        self._trails = {name: plane.Trail(every) for name in (TRUTH, *(shown.name for shown in scene.receivers))}

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for two states or more."""
        return scene.n > 1

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top of the right side."""
        if self.scene.moving:
            return
        trails: dict[str, rrb.VisibleTimeRanges] = {
            _trail(shown.name): self._past(_TRAIL) for shown in self.scene.receivers
        }
        trails[_trail(TRUTH)] = self._past(_TRUTH_TRAIL)
        view = rrb.Spatial2DView(
            name="State plane   white: truth · others coloured as their curves · ellipses: 2σ believed",
            origin=_PATH,
            background=list(GROUND),
            overrides=trails,  # type: ignore[arg-type]
        )
        yield PlacedView(view, "right", 1.75)

    def _past(self, slots: int) -> rrb.VisibleTimeRanges:
        # A piece of a trail is recorded at its end, so the oldest piece shown begins a frame earlier.
        reach = max(slots, 4 * plane.stride(self.scene))
        return rrb.VisibleTimeRanges(
            [
                rrb.VisibleTimeRange(
                    TIMELINE,
                    start=rrb.TimeRangeBoundary.cursor_relative(seq=-reach),
                    end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
                )
            ]
        )

    def styles(self) -> dict[str, rr.AsComponents]:
        """Each estimate in its receiver's colour; the truth white, on top of the others."""
        found = _point_styles(TRUTH, WHITE, radius=3.5, order=40.0)
        for i, shown in enumerate(self.scene.receivers):
            found |= _point_styles(shown.name, colour(i), radius=5.0, order=30.0 - i)
        # Invisible: the view fits its range to it.
        found[_FRAME] = rr.LineStrips2D.from_fields(colors=[GROUND], radii=rr.Radius.ui_points(0.1))
        return found

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Points, trails, ellipses, and the frame around them."""
        k, at = slots.numbers, plane.frames(self.scene, slots.first, slots.count)
        positions = {TRUTH: plane.on_plane(slots.x)}
        positions |= {name: plane.on_plane(peer.x_hat) for name, peer in slots.peers.items()}
        for name, points in positions.items():
            yield from self._moving(name, k, points, at)
        everybody = np.stack([*positions.values()])
        boxes = self._frame.boxes(everybody.min(axis=0), everybody.max(axis=0), at)
        if not len(at):
            return
        yield Column(_FRAME, k[at], rr.LineStrips2D.columns(strips=boxes))
        for name, peer in slots.peers.items():
            ellipses = plane.ellipses(peer.x_hat[at], peer.P[at])
            yield Column(_ellipse(name), k[at], rr.LineStrips2D.columns(strips=ellipses))

    def _moving(
        self, name: str, k: NDArray[np.int64], positions: plane.Points, at: NDArray[np.intp]
    ) -> Iterator[Column]:
        pieces = self._trails[name].pieces(positions, at)
        if len(at):
            yield Column(_trail(name), k[at], rr.LineStrips2D.columns(strips=pieces))
            yield Column(_point(name), k[at], rr.Points2D.columns(positions=positions[at]))


def _point_styles(name: str, bright: Colour, *, radius: float, order: float) -> dict[str, rr.AsComponents]:
    pixels = rr.Radius.ui_points
    return {
        _trail(name): rr.LineStrips2D.from_fields(
            colors=[dim(bright, 0.55)], radii=pixels(0.9), draw_order=order - 20.0
        ),
        _ellipse(name): rr.LineStrips2D.from_fields(colors=[bright], radii=pixels(0.9), draw_order=order - 10.0),
        _point(name): rr.Points2D.from_fields(colors=[bright], radii=pixels(radius), draw_order=order),
    }


def _trail(name: str) -> str:
    return f"{_PATH}/{name}/trail"


def _ellipse(name: str) -> str:
    return f"{_PATH}/{name}/cov"


def _point(name: str) -> str:
    return f"{_PATH}/{name}/at"
