"""What a viewer draws, where the machine has a driver that can draw."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib.image
import numpy as np

from evedrop.errors import UsageError
from evedrop.show.view.picture import opened
from tests.privileged import CannotRun, skip


@contextmanager
def skipped_without_driver() -> Iterator[None]:
    """Skip the test if the block cannot draw for want of a Vulkan driver."""
    try:
        yield
    except UsageError as error:
        if "no Vulkan driver" not in str(error):
            raise
        skip(CannotRun(str(error)))


def filled(png: bytes) -> float:
    """Fraction of the pixels inside a panel that are not its most frequent colour."""
    pixels = np.asarray(matplotlib.image.imread(io.BytesIO(png)))[:, :, :3]
    below_title = 40 if len(pixels) > 2 * 40 else 0
    inside = (pixels[below_title:, :, :] * 255).astype(np.int64) @ np.array([65536, 256, 1])
    return float(np.mean(inside != np.bincount(inside.ravel()).argmax()))


def panels_are_filled(rrd: Path, tab: str, panels: int) -> None:
    """Assert that a tab of a recording has this many panels, that each draws something, and that none complains."""
    with skipped_without_driver(), opened(rrd, (1600, 950), panel=tab) as viewer:
        views = viewer.state().views
        fractions = {f"{view.name} {view.view_id}": filled(viewer.take(view.view_id)) for view in views}
        complaints = [view.reports for view in views if view.reports]
    assert len(fractions) == panels, fractions
    assert min(fractions.values()) > 0.004, fractions
    assert complaints == []
