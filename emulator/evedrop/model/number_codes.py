"""How numbers are carried in packets: quantised with subtractive dither, or masked by pads.

The error of the quantiser is white noise, whatever the state is. With ideal pads a masked number is a random number of its range,
whatever its value is. Both need the variances of single states, slot by slot, in arithmetic that gives the same bits on every
machine.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process
from evedrop.model.streams import Ahead, Batch, BlockReader, Recurrence


@final
class StateVariances:
    """Σ_k[i, i], (n,). Slots may be asked for in any order; in order is quick.

    Source: docs/mathematics/model.md, model.
    """

    def __init__(self, process: Process) -> None:
        first = process.initial_covariance[:, :, None]
        self._sigma = Recurrence(first, lambda sigma: process.diffuse(process.carry(sigma)))

    def at(self, k: int) -> Floats:
        """The variances in slot k, (n,)."""
        sigma = self._sigma.at(k)
        return np.array([sigma[i, i, 0] for i in range(len(sigma))])


MOST_BITS = 32


@final
class DitheredQuantiser:
    """Rounds a state plus dither to one of 2^bits levels; a reader of the level subtracts the dither.

    State i of slot k has levels over [−H, H), H = `standard_deviations` · √Σ_k[i, i], in steps Δ = 2H · 2^−bits. The dither d
    is uniform on [−Δ/2, Δ/2). The value read differs from the state by a number that is uniform on (−Δ/2, Δ/2] and independent
    of the state, as long as state plus dither lies in the range; beyond, it is cut to the last level (overload).

    Source: docs/mathematics/schemes.md, quantised packets.
    """

    def __init__(self, process: Process, bits: int, standard_deviations: float, key: bytes, batch: Batch) -> None:
        self._bits, self._standard_deviations = bits, standard_deviations
        self._variances = StateVariances(process)
        self._steps: dict[int, Floats] = {}
        reader = BlockReader(key, batch, process.n)
        self._dither = Ahead(reader.ahead, lambda slots: reader.uniforms(slots) - 0.5)

    def steps(self, k: int) -> Floats:
        """Δ of every state in slot k, (n,)."""
        if k not in self._steps:
            self._steps = {k: np.ldexp(self._standard_deviations * np.sqrt(self._variances.at(k)), 1 - self._bits)}
        return self._steps[k]

    def levels(self, k: int, x: Floats) -> NDArray[np.int64]:
        """The level of every state, (n, R), from 0 to 2^bits − 1, from x_k (n, R)."""
        half, steps = 2.0 ** (self._bits - 1), self.steps(k)[:, None]
        # A step of 0 is that of a state that is known: it is 0.
        scaled = np.floor(x / np.where(steps > 0.0, steps, 1.0) + self._dither.at(k))
        return (np.minimum(np.maximum(scaled, -half), half - 1.0) + half).astype(np.int64)

    def centres(self, k: int, levels: NDArray[np.int64]) -> Floats:
        """The numbers in the middle of the levels, (n, R)."""
        return (levels - 2.0 ** (self._bits - 1) + 0.5) * self.steps(k)[:, None]

    def levels_of(self, k: int, centres: Floats) -> NDArray[np.int64]:
        """The levels whose middles these are, (n, R)."""
        steps = self.steps(k)[:, None]
        levels_: NDArray[np.int64] = np.rint(
            centres / np.where(steps > 0.0, steps, 1.0) + (2.0 ** (self._bits - 1) - 0.5)
        ).astype(np.int64)
        return levels_

    def read(self, k: int, levels: NDArray[np.int64]) -> Floats:
        """The state as it is read from levels, (n, R)."""
        return self.centres(k, levels) - self._dither.at(k) * self.steps(k)[:, None]


@final
class LevelPad:
    """Pads for levels: with ideal pads a masked level is uniform, whatever the level is."""

    def __init__(self, n: int, bits: int, key: bytes, batch: Batch) -> None:
        self._most = 2**bits - 1
        reader = BlockReader(key, batch, n)
        self._pads = Ahead(reader.ahead, lambda slots: (reader.uniforms(slots) * 2.0**bits).astype(np.int64))

    def hide(self, k: int, levels: NDArray[np.int64]) -> NDArray[np.int64]:
        """The masked levels, (n, R)."""
        masked: NDArray[np.int64] = (levels + self._pads.at(k)) & self._most
        return masked

    def reveal(self, k: int, masked: NDArray[np.int64]) -> NDArray[np.int64]:
        """The levels, (n, R), from the result of `hide`."""
        levels: NDArray[np.int64] = (masked - self._pads.at(k)) & self._most
        return levels


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
        turned = (points + _HALF + sign * self._pads.at(k)) & (2 * _HALF - 1)
        return np.ldexp((turned - _HALF).astype(np.float64), -shift)

    def _exponent(self, k: int) -> NDArray[np.int32]:
        """The exponents of H in slot k, (n,); those of the last two slots are cached."""
        if k not in self._exponents:
            self._exponents = {k: np.frexp(STANDARD_DEVIATIONS * np.sqrt(self._variances.at(k)))[1]}
        return self._exponents[k]
