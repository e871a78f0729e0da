"""How long ago, as far as the sensor knows, the user last had the state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evedrop.model.receiver import Flags

_NEVER = -(2**62)


class HoldingTime:
    """h_k = k − t, t the last acknowledged slot, for every trial; without end before the first acknowledgement.

    Final. What is blocked or lost on the way back makes h too large, never too small.

    Source: docs/mathematics.md, schedules by holding time.
    """

    def __init__(self, trials: int) -> None:
        self._slot: NDArray[np.int64] = np.full(trials, _NEVER, np.int64)

    def reached(self, k: int, threshold: int) -> Flags:
        """Whether h_k ≥ threshold, (R,)."""
        flags: Flags = k - self._slot >= threshold
        return flags

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Take the acknowledgements (R,) of slot k, in any order of slots."""
        self._slot = np.where(acknowledged, np.maximum(self._slot, k), self._slot)
