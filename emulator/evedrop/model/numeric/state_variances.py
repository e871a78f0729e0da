"""The variances of single states, slot by slot, in arithmetic that gives the same bits on every machine."""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.process import Floats, Process


@final
class StateVariances:
    """Σ_k[i, i], (n,). Slots may be asked for in any order; in order is quick.

    Source: docs/mathematics.md, model.
    """

    def __init__(self, process: Process) -> None:
        self._process = process
        self._k = 0
        self._sigma: Floats = process.initial_covariance[:, :, None]

    def at(self, k: int) -> Floats:
        """The variances in slot k, (n,)."""
        if k < self._k:
            self._k, self._sigma = 0, self._process.initial_covariance[:, :, None]
        while self._k < k:
            self._sigma = self._process.diffuse(self._process.carry(self._sigma))
            self._k += 1
        return np.array([self._sigma[i, i, 0] for i in range(self._process.n)])
