"""What one twin track reveals about the other: the distribution of their distance.

A track of slot k is a = F ξ + η, its twin b = F ξ' + η, with F = A^k L0 and the same noise η ~ N(0, N_k).
Given a, the distance b − a has mean −A^k Σ0 A^kᵀ Σ_k⁻¹ a, whichever of the two is the true one. One triangularisation
gives everything, without a difference and without Σ_k:

    [ F  N_k^½  0]   [L_k   0     ]
    [−F   0     F] = [G     R_k^½ ] U,   U orthogonal, L_k L_kᵀ = Σ_k; b − a given a: mean G L_k⁻¹ a, covariance R_k.

Source: docs/mathematics.md, twin track.
"""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.kernels.factored import Factor, solved
from evedrop.model.process import Floats, Process, product


@final
class Apart:
    """The distance to the twin, given one track of a slot; its numbers depend only on the process."""

    def __init__(self, start: Floats, noise: Floats) -> None:
        n = len(start)
        nothing = np.zeros((n, n))
        joint = kernels.triangular_factors(np.block([[start, noise, nothing], [-start, nothing, start]])[None])[0]
        self._state = joint[:n, :n].tolist()
        self._gain = joint[n:, :n]
        self.factor = Factor.of_triangular(joint[n:, n:].tolist())
        """R_k, factored."""

    def mean(self, a: Floats) -> Floats:
        """G L_k⁻¹ a, (n, R), of tracks a (n, R)."""
        return product(self._gain, solved(self._state, a))


@final
class Twins:
    """`Apart` of any slot; asking for slots in order is quick."""

    def __init__(self, process: Process) -> None:
        self._A, self._noise = process.A, process.noise_factor
        self._first = cholesky(process.initial_covariance), np.zeros((process.n, process.n))
        self._k = 0
        self._start, self._late = self._first

    def at(self, k: int) -> Apart:
        """The distance in slot k."""
        if k < self._k:
            self._k, (self._start, self._late) = 0, self._first
        while self._k < k:
            self._start = product(self._A, self._start)
            self._late = kernels.triangular_factors(
                np.concatenate([product(self._A, self._late), self._noise], axis=1)[None]
            )[0]
            self._k += 1
        return Apart(self._start, self._late)
