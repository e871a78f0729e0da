"""What somebody who follows a house's battery can tell about the house: when its people are at home, and at it.

A day is cut into windows. In some the house is *active*: its mean load there is at or above a threshold, as it is when
somebody cooks or washes, and hardly otherwise. Whoever has guessed the load of every window takes the larger guesses for
activity. How well that works is the area under the curve of detections over false alarms: 1 if every active window's guess
is above every quiet one's, ½ for a coin.

Source: docs/microgrid.md, privacy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats

Flags = NDArray[np.bool_]


def means(values: Floats, window: int) -> Floats:
    """Means over each window, (windows, …), of values (slots, …). A last window that is not whole is left out."""
    windows = len(values) // window
    mean: Floats = values[: windows * window].reshape(windows, window, *values.shape[1:]).mean(axis=1)
    return mean


def active(load: Floats, window: int, threshold: float) -> Flags:
    """In which windows the house is active, (windows,); load: (slots,) in kW, as is the threshold."""
    return np.greater_equal(means(load, window), threshold)


def area(score: Floats, truth: Flags) -> float:
    """Area under the curve: how often an active window scores above a quiet one, ties counted half; NaN if there are not both.

    score: (windows,), the larger the likelier active; truth: (windows,).
    """
    on, off = score[truth], np.sort(score[~truth])
    if not len(on) or not len(off):
        return float("nan")
    below = np.searchsorted(off, on, side="left") + np.searchsorted(off, on, side="right")
    return float(0.5 * below.sum() / (len(on) * len(off)))


def detection_rate(score: Floats, truth: Flags, false_alarms: float) -> float:
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
