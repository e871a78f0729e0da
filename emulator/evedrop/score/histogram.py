"""Quantiles over trials, slot by slot, from histograms that add up: the same for any number of workers, in bounded memory.

A bin is a quarter of an octave wide (the exponent and two bits of the mantissa), so a quantile is within 25 % of the
exact one; interpolation usually brings it within a few per cent. 512 bins span 128 octaves; smaller values count as 0,
and larger ones as infinite.
"""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats

LEVELS = (0.05, 0.5, 0.95)
"""The quantiles that are reported."""
_BINS = 512
_OCTAVES_BELOW = 24  # octaves below the scale
_MOST_ROWS = 4096
_SHIFT = 50  # keeps sign, exponent and two bits of the mantissa


@final
class SlotHistograms:
    """Histograms of one quantity in at most 4096 evenly spaced slots of a run."""

    def __init__(self, slots: int, scale: float) -> None:
        self._slots = slots
        self._stride = -(-slots // _MOST_ROWS)
        self._base = int(np.float64(scale * 2.0**-_OCTAVES_BELOW).view(np.int64)) >> _SHIFT
        self.counts = np.zeros((-(-slots // self._stride), _BINS), np.uint32)
        """The number of values in each histogram and bin, (histograms, 512)."""

    def add_values(self, first: int, values: Floats) -> None:
        """Add the values (c, R), none negative, of slots first … first+c−1."""
        skip = -first % self._stride
        chosen = values[skip :: self._stride]
        rows = len(chosen)
        if not rows:
            return
        start = (first + skip) // self._stride
        kernels.add_to_histograms(self.counts[start : start + rows], chosen, _SHIFT, self._base)

    def merge(self, other: SlotHistograms) -> None:
        """Add the histograms of further trials."""
        self.counts += other.counts

    def __getstate__(self) -> dict[str, Any]:
        """The state as a worker sends it: only the filled bins, a few per cent of up to two million."""
        filled = np.flatnonzero(self.counts).astype(np.uint32)
        return {**self.__dict__, "counts": (self.counts.shape, filled, self.counts.reshape(-1)[filled])}

    def __setstate__(self, state: dict[str, Any]) -> None:
        shape, filled, values = state["counts"]
        counts = np.zeros(shape, np.uint32)
        counts.reshape(-1)[filled] = values
        self.__dict__.update(state, counts=counts)

    def quantiles(self) -> Floats:
        """`LEVELS` of every slot, (slots, levels); NaN in slots that were left out or have no values."""
        edges = self._edges()
        quantiles = np.full((self._slots, len(LEVELS)), np.nan)
        totals = self.counts.sum(axis=1)
        cumulative = np.cumsum(self.counts, axis=1)
        rows = np.flatnonzero(totals)
        for column, level in enumerate(LEVELS):
            wanted = level * totals[rows]
            bins = np.minimum((cumulative[rows] < wanted[:, None]).sum(axis=1), _BINS - 1)
            count = self.counts[rows, bins]
            before = cumulative[rows, bins] - count
            part = np.clip((wanted - before) / np.maximum(count, 1), 0.0, 1.0)
            values = edges[bins] + part * (edges[bins + 1] - edges[bins])
            # In the first and the last bin, values are known only to be too small or too large.
            quantiles[rows * self._stride, column] = np.select([bins == 0, bins == _BINS - 1], [0.0, np.inf], values)
        return quantiles

    def _edges(self) -> Floats:
        bits = (self._base + np.arange(_BINS + 1, dtype=np.int64)) << _SHIFT
        edges: NDArray[np.float64] = bits.view(np.float64).copy()
        edges[0] = 0.0
        return edges
