"""What somebody who follows a house's battery can tell about the house: when its people are at home, and at it.

A day is cut into windows. In some the house is *active*: its mean load there is at or above a threshold, as it is when
somebody cooks or washes, and hardly otherwise. Whoever has an estimate of the battery's level sees it fall in such a window,
and guesses so the more, the more it falls. How well that works is the area under the curve of detections over
false alarms: 1 if every active window falls by more than every quiet one, ½ for a coin.

Source: docs/microgrid.md, privacy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats

Flags = NDArray[np.bool_]

THRESHOLD = 1.0
"""kW: nothing that is always on draws that much."""
WINDOW_SECONDS = 300.0
FALSE_ALARMS = 0.05


def active(load: Floats, window: int, threshold: float = THRESHOLD) -> Flags:
    """In which windows the house is active, (windows,); load: (slots,) in kW. A last window that is not whole is left out."""
    windows = len(load) // window
    means: Floats = load[: windows * window].reshape(windows, window).mean(axis=1)
    return np.greater_equal(means, threshold)


def fall(level: Floats, window: int, known: Floats | None = None) -> Floats:
    """By how much a level falls in each window, (windows, R); level: (slots, R), or (slots,) for one.

    known: what the observer knows to have moved the level from each slot to the next, (slots,), such as the sun, which
    shines on its own roof too. The last window counts if the slot after it is there.
    """
    levels = level.reshape(len(level), -1)
    ends = levels[::window]
    fallen: Floats = ends[:-1] - ends[1:]
    if known is not None:
        moved = np.concatenate([[0.0], np.cumsum(known)])[: len(levels)][::window]
        fallen = fallen + np.diff(moved)[:, None]
    return fallen


def area(score: Floats, truth: Flags) -> float:
    """Area under the curve: how often an active window scores above a quiet one, ties counted half; NaN if there are not both.

    score: (windows,), the larger the likelier active; truth: (windows,).
    """
    on, off = score[truth], np.sort(score[~truth])
    if not len(on) or not len(off):
        return float("nan")
    below = np.searchsorted(off, on, side="left") + np.searchsorted(off, on, side="right")
    return float(0.5 * below.sum() / (len(on) * len(off)))


def detection_rate(score: Floats, truth: Flags, false_alarms: float = FALSE_ALARMS) -> float:
    """Share of active windows that are found where the share `false_alarms` of the quiet ones is taken for active.

    Windows that score alike at the threshold are decided by a coin, so that whoever knows nothing finds `false_alarms`.
    NaN if there are not both kinds.
    """
    on, off = score[truth], np.sort(score[~truth])[::-1]
    if not len(on) or not len(off):
        return float("nan")
    allowed = false_alarms * len(off)
    threshold = off[min(int(allowed), len(off) - 1)]
    above, alike = int(np.sum(off > threshold)), int(np.sum(off == threshold))
    share = min(1.0, (allowed - above) / alike)
    return float(np.mean(on > threshold) + share * np.mean(on == threshold))
