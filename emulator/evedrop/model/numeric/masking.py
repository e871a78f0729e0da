"""Pads for numbers: with ideal pads a masked number is a random number of its range, whatever its value is.

Source: docs/mathematics.md, masking.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.numeric.state_variances import StateVariances
from evedrop.model.process import Floats, Process
from evedrop.model.streams import Ahead, Batch, BlockReader

STANDARD_DEVIATIONS = 16.0
"""The range extends at least this many standard deviations of the state to either side; beyond lies less than 2⁻¹⁸⁹."""
_RANGE_BITS = 53  # so that every number of the range is a float64
_HALF = 2**52


@final
class Mask:
    """Adds the pad of a slot to a state, modulo a public range, and removes it again.

    State i of slot k is rounded to a grid of 2⁵³ points over [−H, H), with H the least power of two above 16 √Σ_k[i, i];
    the pad, uniform on the same grid, is added modulo 2H. The masked state is therefore finite, uniform on the grid
    whatever the state is, and reveals nothing about it. Slots may be asked for in any order; in order is quick.
    """

    def __init__(self, process: Process, key: bytes, batch: Batch) -> None:
        reader = BlockReader(key, batch, process.n)
        self._pads = Ahead(reader.ahead, lambda slots: (reader.uniforms(slots) * 2.0**_RANGE_BITS).astype(np.int64))
        self._variances = StateVariances(process)
        self._exponents: dict[int, NDArray[np.int32]] = {}

    def hide(self, k: int, x: Floats) -> Floats:
        """The masked state, (n, R), from x_k (n, R)."""
        return self._turned(k, x, 1)

    def reveal(self, k: int, z: Floats) -> Floats:
        """The state on its grid, (n, R), from the result of `hide`."""
        return self._turned(k, z, -1)

    def steps(self, k: int) -> Floats:
        """Distance of the grid's points in slot k, (n,): the resolution of masking."""
        return np.ldexp(1.0, self._exponent(k) + 1 - _RANGE_BITS)

    def _turned(self, k: int, values: Floats, sign: int) -> Floats:
        exponent = self._exponent(k)[:, None]
        shift = _RANGE_BITS - 1 - exponent
        H = np.ldexp(1.0, exponent)
        # A state beyond 16 standard deviations is clipped to the range, not wrapped.
        points = np.rint(np.ldexp(np.minimum(np.maximum(values, -H), H), shift)).astype(np.int64)
        points = np.minimum(points, _HALF - 1)
        turned = (points + _HALF + sign * self._pad(k)) & (2 * _HALF - 1)
        masked: Floats = np.ldexp((turned - _HALF).astype(np.float64), -shift)
        return masked

    def _pad(self, k: int) -> NDArray[np.int64]:
        return self._pads.at(k)

    def _exponent(self, k: int) -> NDArray[np.int32]:
        """The exponents of H in slot k, (n,); those of the last two slots are cached."""
        if k not in self._exponents:
            self._exponents = {k: np.frexp(STANDARD_DEVIATIONS * np.sqrt(self._variances.at(k)))[1]}
        return self._exponents[k]
