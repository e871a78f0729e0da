"""How much an estimate of a house's battery reveals about the house: when people are at home and active.

A day is divided into windows. In some of them the house is *active*: its mean load is at or above a threshold, which hardly
happens unless somebody cooks or washes. A receiver that has guessed the load of every window takes the larger guesses
for activity. The measure of success is the area under the curve of detections over false alarms: 1 if the guess for every
active window is above that for every quiet one, ½ for a coin.

Source: docs/microgrid.md, privacy.
"""

from __future__ import annotations

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


def means(values: Floats, window: int) -> Floats:
    """Means over each window, (windows, …), of values (slots, …). An incomplete last window is left out."""
    windows = len(values) // window
    mean: Floats = values[: windows * window].reshape(windows, window, *values.shape[1:]).mean(axis=1)
    return mean


def active(load: Floats, window: int, threshold: float) -> Flags:
    """Whether the house is active in each window, (windows,); load: (slots,), in kW like the threshold."""
    return np.greater_equal(means(load, window), threshold)


def area(score: Floats, truth: Flags) -> float:
    """Area under the curve: how often an active window scores above a quiet one, ties counted half; NaN without both kinds.

    score: (windows,), the larger the likelier active; truth: (windows,).
    """
    on, off = score[truth], np.sort(score[~truth])
    if not len(on) or not len(off):
        return float("nan")
    below = np.searchsorted(off, on, side="left") + np.searchsorted(off, on, side="right")
    return float(0.5 * below.sum() / (len(on) * len(off)))


def detection_rate(score: Floats, truth: Flags, false_alarms: float) -> float:
    """Fraction of active windows that are detected if the fraction `false_alarms` of the quiet ones is taken for active.

    A coin decides between windows with equal scores at the threshold, so that a receiver without knowledge detects the
    fraction `false_alarms`. NaN without both kinds of windows.
    """
    on, off = score[truth], np.sort(score[~truth])[::-1]
    if not len(on) or not len(off):
        return float("nan")
    allowed = false_alarms * len(off)
    threshold = off[min(int(allowed), len(off) - 1)]
    above, alike = int(np.sum(off > threshold)), int(np.sum(off == threshold))
    fraction = min(1.0, (allowed - above) / alike)
    return float(np.mean(on > threshold) + fraction * np.mean(on == threshold))
