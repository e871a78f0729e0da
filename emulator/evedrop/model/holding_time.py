"""The time since the user last had the state, as far as the sensor knows."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.receiver import Flags

_NEVER = -(2**62)


@final
class HoldingTime:
    """h_k = k − t with the last acknowledged slot t, for every trial; infinite before the first acknowledgement.

    Acknowledgements that are blocked or lost make h too large, never too small.

    Source: docs/mathematics.md, schedules by holding time.
    """

    def __init__(self, trials: int) -> None:
        self._slot: NDArray[np.int64] = np.full(trials, _NEVER, np.int64)

    def reached(self, k: int, threshold: int) -> Flags:
        """Whether h_k ≥ threshold, (R,)."""
        flags: Flags = k - self._slot >= threshold
        return flags

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Add the acknowledgements (R,) of slot k; slots may come in any order."""
        self._slot = np.where(acknowledged, np.maximum(self._slot, k), self._slot)
