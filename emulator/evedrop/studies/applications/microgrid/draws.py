"""Random numbers from a named stream, in the order in which they are asked for; used to make a day.

Source: docs/mathematics.md, random numbers.
"""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.kernels.elementary import log
from evedrop.model.streams import Floats, Stream, normals, root_of_seed, stream_key, uniforms


@final
class Draws:
    """The numbers of one stream, in order."""

    def __init__(self, seed: int, name: str) -> None:
        self._stream = Stream(stream_key(root_of_seed(seed), name), range(1), 1)
        self._next = 0

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """A number between low and high."""
        return float(low + (high - low) * self.uniforms(1)[0])

    def uniforms(self, count: int) -> Floats:
        """Numbers in [0, 1), (count,)."""
        return uniforms(self._stream.words(self._ahead(count)))[:, 0, 0]

    def normals(self, count: int) -> Floats:
        """Standard normals, (count,)."""
        return normals(self._stream.words(self._ahead(count)))[:, 0, 0]

    def exponential(self, mean: float) -> float:
        """An exponentially distributed time."""
        return float(-mean * log(1.0 - self.uniforms(1))[0])

    def times(self, rate: Floats) -> list[int]:
        """Places of a Poisson process, in order: `rate` is the expected number at each, (places,)."""
        total = np.cumsum(rate)
        times, reached = [], self.exponential(1.0)
        while reached < total[-1]:
            times.append(int(np.searchsorted(total, reached, side="right")))
            reached += self.exponential(1.0)
        return times

    def _ahead(self, count: int) -> range:
        self._next += count
        return range(self._next - count, self._next)
