"""The legend of all panels: what each colour stands for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view import lanes
from evedrop.show.view.column import Column
from evedrop.show.view.palette import GROUND, TRUTH, Colour, colour
from evedrop.show.view.panels.heights import LEGEND_HEIGHT
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import SceneSlots

_PATH = "legend"
_WIDE, _HIGH = 60.0, 44.0  # of the drawing, for each letter and line


@final
class Legend(ViewPanel):
    """A line over the whole width: the receivers' colours, then those of packets. Most colours have a word in one place only."""

    def views(self) -> Iterator[PlacedView]:
        """One view without a title bar, whose range shows all words."""
        width = self._places()[-1][0] + self._width(self._entries()[-1][0]) / 2
        bounds = rrb.VisualBounds2D(x_range=(0.0, width), y_range=(-10.0, 30.0))
        view = rrb.Spatial2DView(origin=_PATH, titlebar=False, background=list(GROUND), visual_bounds=bounds)
        yield PlacedView(view, "legend", height=LEGEND_HEIGHT)

    def styles(self) -> dict[str, rr.AsComponents]:
        """Dots in the colours, and the words below them, which do not change."""
        words, colours = zip(*self._entries(), strict=True)
        places, size = self._places(), rr.Radius.ui_points
        return {
            f"{_PATH}/dots": rr.Points2D(places, colors=colours, radii=size(6.0)),
            f"{_PATH}/words": rr.Points2D(places, colors=[TRUTH], radii=size(0.0), labels=words, show_labels=True),
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Nothing: the legend is a style."""
        del slots
        yield from ()

    def _entries(self) -> list[tuple[str, Colour]]:
        receivers = [(shown.name, colour(i)) for i, shown in enumerate(self.scene.receivers)]
        return [("truth", TRUTH), *receivers, *lanes.legend()]

    def _places(self) -> list[tuple[float, float]]:
        places, at = [], 0.0
        for word, _ in self._entries():
            places.append((at + self._width(word) / 2, 0.0))
            at += self._width(word)
        return places

    @staticmethod
    def _width(word: str) -> float:
        return 7.0 * len(word) + 26.0
