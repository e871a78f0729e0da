"""Heights of rows and lanes, as fractions of a small window of 720 pixels. Larger windows have room to spare."""

from __future__ import annotations

from evedrop.show.view.scene import Scene

_PIXELS = 654.0  # between the viewer's own bars
_MOST = 0.57
_HEAD, _LANE = 48.0, 40.0  # title bar and ruler of a view of lanes; a lane with its name

TITLE_HEIGHT = 0.06
LEGEND_HEIGHT = 0.075
FIXED_HEIGHT = TITLE_HEIGHT + LEGEND_HEIGHT
"""The height of the rows that every view has."""


def lanes_height(count: int) -> float:
    """The fraction that a view of `count` lanes needs; eight lanes fit, and more can be reached by scrolling."""
    return min(_MOST, (_HEAD + _LANE * count) / _PIXELS)


def crowded(scene: Scene) -> bool:
    """Whether two views of lanes do not fit below each other, so that both are in the row at the top."""
    return 1.0 - FIXED_HEIGHT - lanes_height(len(scene.receivers)) - lanes_height(len(scene.receivers) + 1) < 0.1
