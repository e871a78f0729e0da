"""The panels of the scenario's applications."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.column import Column, scalars
from evedrop.show.view.palette import colour
from evedrop.show.view.panels.curves import curves_view, line_style, thinned, whole_run
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import Scene, SceneSlots


@final
class ApplicationPanels(ViewPanel):
    """A view for each panel that an application describes, over the whole run."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop with an application that has panels."""
        return bool(scene.panels)

    def views(self) -> Iterator[PlacedView]:
        """Panels of the plant on the left, panels of the receivers' beliefs on the right."""
        for panel in self.scene.panels:
            span = None if panel.span is None else rrb.ScalarAxis(range=panel.span, zoom_lock=True)
            view = curves_view(panel.title, panel.path, whole_run(self.scene), span, legend=not panel.with_beliefs)
            yield PlacedView(view, "right", 1.2) if panel.with_beliefs else PlacedView(view, "left")

    def styles(self) -> dict[str, rr.SeriesLines | rr.SeriesPoints]:
        """The styles that the application describes; a receiver's own colour if it gives none."""
        colours = {shown.name: colour(i) for i, shown in enumerate(self.scene.receivers)}
        styles: dict[str, rr.SeriesLines | rr.SeriesPoints] = {}
        for panel in self.scene.panels:
            for curve in panel.curves:
                bright = curve.colour or colours[curve.name]
                styles[f"{panel.path}/{curve.name}"] = (
                    rr.SeriesPoints(names=curve.name, colors=bright, markers="circle", marker_sizes=curve.width)
                    if curve.drawn == "points"
                    else line_style(curve.name, bright, curve.width, steps=curve.drawn == "steps")
                )
        return styles

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A column for every curve: lines are thinned, points are not."""
        if slots.moved is None:
            return
        for panel in self.scene.panels:
            for curve in panel.curves:
                path = f"{panel.path}/{curve.name}"
                numbers, values = slots.moved.curves[path]
                k = numbers.astype(np.int64)
                at = np.arange(len(k)) if curve.drawn == "points" else thinned(self.scene, k)
                if len(at):
                    yield scalars(path, k[at], values[at])
