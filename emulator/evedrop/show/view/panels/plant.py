"""The panel of the disturbances and inputs that move the plant of a closed loop."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import final

import rerun as rr

from evedrop.show.view.column import Column, scalars
from evedrop.show.view.palette import PLANT
from evedrop.show.view.panels.curves import curves_view, line_style, thinned, whole_run
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import Scene, SceneSlots

_PATH = "moving"


@final
class WhatMovesThePlant(ViewPanel):
    """Disturbances, and inputs as the plant's limits clip them, over the whole run."""

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Only for a closed loop."""
        return bool(scene.moving)

    def views(self) -> Iterator[PlacedView]:
        """One view, at the top of the left side."""
        title = "What moves the plant: " + ", ".join(self.scene.moving)
        yield PlacedView(curves_view(title, _PATH, whole_run(self.scene)), "left", 1.3)

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Steps, because a value holds for its whole slot."""
        return {
            _curve(label): line_style(label, PLANT[i % len(PLANT)], 1.4, steps=True)
            for i, label in enumerate(self.scene.moving)
        }

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """A curve for each disturbance and input."""
        at = thinned(self.scene, slots.numbers)
        if slots.moved is not None and len(at):
            for label, values in zip(self.scene.moving, slots.moved.values.T, strict=True):
                yield scalars(_curve(label), slots.numbers[at], values[at])


def _curve(label: str) -> str:
    return f"{_PATH}/{re.sub(r'[^A-Za-z0-9_-]+', '_', label)}"
