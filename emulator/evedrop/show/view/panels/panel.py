"""The base class of the panels of the view. The recording and the layout ask each panel; neither knows a panel's paths.

Heights of rows and lanes are fractions of a small window of 720 pixels. Larger windows have room to spare.

Source: docs/your-own/panel.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

from evedrop.score.verdict import Verdict
from evedrop.show.view.attacks import lane_count
from evedrop.show.view.column import Column
from evedrop.show.view.events import Event
from evedrop.show.view.scene import Scene, SceneSlots

Side = Literal["verdict", "top", "left", "middle", "right", "legend", "truth", "worlds", "strip"]
"""A place in the view: `verdict` is the row above both tabs.

The tab with numbers has the rows `top` and `legend`, and the columns `left`, `middle` and `right` between them. The tab with the
scene has `truth` on the left, `worlds` in a grid beside it, and the row `strip` below.
"""
SCENE: tuple[Side, ...] = ("truth", "worlds", "strip")
ROWS_ABOVE: tuple[Side, ...] = ("top",)
COLUMNS: tuple[Side, ...] = ("left", "middle", "right")
ROWS_BELOW: tuple[Side, ...] = ("legend",)


@dataclass(frozen=True)
class PlacedView:
    """A Rerun view and its place: in a row over the whole width, or in a column between the rows."""

    view: rrb.View
    side: Side
    share: float = 1.0
    """Its height, compared with the other views of its column, or its width, compared with those of its row; most have 1."""
    height: float = 0.0
    """Of a view in a row: the share of the window's height that it needs. The row is as high as its highest view."""


class ViewPanel(ABC):
    """A panel of the view. The class is registered; each recording makes an instance of it before the first slot.

    Its paths in the recording begin with a word that no other panel uses. Views show entity names, so keep these short.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @classmethod
    def applies(cls, scene: Scene) -> bool:
        """Whether the recording of this run has the panel; by default always."""
        del scene
        return True

    @abstractmethod
    def views(self) -> Iterable[PlacedView]:
        """Its views; none if it is recorded but not shown."""

    def styles(self) -> Mapping[str, rr.AsComponents | Iterable[rr.DescribedComponentBatch]]:
        """Path → name, colour and other styles, recorded once; by default none, so that Rerun chooses."""
        return {}

    @abstractmethod
    def columns(self, slots: SceneSlots) -> Iterable[Column]:
        """Its values in the next slots. Calls are in order of slot; the arrays cannot be written to."""

    def conclusion(self, k: int, verdict: Verdict) -> Iterable[Column]:
        """Its values for the verdict on the run, at its last slot k; by default none."""
        del k, verdict
        return ()

    def notes(self, notes: Sequence[Event]) -> Iterable[Column]:
        """Its values for lines about the run, such as "cut smart"; by default none."""
        del notes
        return ()


_PIXELS = 544.0  # of the tab with numbers, below the verdict and between the viewer's own bars
_MOST = 0.57
_HEAD, _LANE = 48.0, 40.0  # title bar and ruler of a view of lanes; a lane with its name

VERDICT_HEIGHT = 0.165  # two lines of a verdict, and the title, in a window of 720 pixels
LEGEND_HEIGHT = 0.085
FIXED_HEIGHT = LEGEND_HEIGHT
"""The height of the rows that the numbers of every run have."""


def lanes_height(count: int) -> float:
    """The fraction of a tab that a view of `count` lanes needs; eight lanes fit, and more can be reached by scrolling."""
    return min(_MOST, (_HEAD + _LANE * count) / _PIXELS)


def crowded(scene: Scene) -> bool:
    """Whether two views of lanes do not fit below each other, so that both are in the row at the top."""
    known, packets = len(scene.receivers), len(scene.receivers) + 1 + lane_count(scene)
    return 1.0 - FIXED_HEIGHT - lanes_height(known) - lanes_height(packets) < 0.05
