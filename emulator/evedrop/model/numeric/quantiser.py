"""A uniform quantiser with subtractive dither: its error is white noise, whatever the state is.

Source: docs/mathematics.md, quantised packets.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.numeric.state_variances import StateVariances
from evedrop.model.process import Floats, Process
from evedrop.model.streams import Ahead, Batch, BlockReader

MOST_BITS = 32


@final
class DitheredQuantiser:
    """Rounds a state plus dither to one of 2^bits levels; a reader of the level subtracts the dither.

    State i of slot k has levels over [−H, H), H = `standard_deviations` · √Σ_k[i, i], in steps Δ = 2H · 2^−bits. The dither d
    is uniform on [−Δ/2, Δ/2). The value read differs from the state by a number that is uniform on (−Δ/2, Δ/2] and independent
    of the state, as long as state plus dither lies in the range; beyond, it is cut to the last level (overload).

    Source: docs/mathematics.md, quantised packets.
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
        levels: NDArray[np.int64] = (np.minimum(np.maximum(scaled, -half), half - 1.0) + half).astype(np.int64)
        return levels

    def centres(self, k: int, levels: NDArray[np.int64]) -> Floats:
        """The numbers in the middle of the levels, (n, R)."""
        found: Floats = (levels - 2.0 ** (self._bits - 1) + 0.5) * self.steps(k)[:, None]
        return found

    def levels_of(self, k: int, centres: Floats) -> NDArray[np.int64]:
        """The levels whose middles these are, (n, R)."""
        steps = self.steps(k)[:, None]
        found: NDArray[np.int64] = np.rint(
            centres / np.where(steps > 0.0, steps, 1.0) + (2.0 ** (self._bits - 1) - 0.5)
        ).astype(np.int64)
        return found

    def read(self, k: int, levels: NDArray[np.int64]) -> Floats:
        """The state as it is read from levels, (n, R)."""
        found: Floats = self.centres(k, levels) - self._dither.at(k) * self.steps(k)[:, None]
        return found


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
