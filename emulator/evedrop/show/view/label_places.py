"""Places for names beside the ends of curves, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from evedrop.model.process import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def end_of(axes: Axes, heights: Floats) -> float:
    """Where a curve of these heights ends: its last finite one, as a fraction of the axis; the lower end without any."""
    finite, (low, high) = heights[np.isfinite(heights)], axes.get_ylim()
    height = float(np.clip(finite[-1], low, high)) if finite.size else low
    return float(axes.transAxes.inverted().transform(axes.transData.transform((0.0, height)))[1])


def label_places(ends: Sequence[float], gap: float) -> list[float]:
    """Places for labels beside the ends of curves, which are fractions of an axis: at least `gap` apart, and near the ends."""
    order = sorted(range(len(ends)), key=lambda i: ends[i])
    places = [ends[i] for i in order]
    for _ in range(len(places) ** 2):
        close = next((i for i in range(1, len(places)) if places[i] - places[i - 1] < gap * (1 - 1e-9)), None)
        if close is None:
            break
        first, last = close - 1, close  # a group of labels that are a gap apart around the middle of their ends
        while True:
            middle = sum(ends[i] for i in order[first : last + 1]) / (last + 1 - first)
            start = min(max(0.0, middle - gap * (last - first) / 2), max(0.0, 1.0 - gap * (last - first)))
            if first and places[first - 1] > start - gap * (1 - 1e-9):
                first -= 1
            elif last + 1 < len(places) and places[last + 1] < start + gap * (last + 1 - first) * (1 - 1e-9):
                last += 1
            else:
                break
        places[first : last + 1] = [start + gap * i for i in range(last + 1 - first)]
    return [place for _, place in sorted(zip(order, places, strict=True))]
