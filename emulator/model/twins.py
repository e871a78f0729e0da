"""What one twin track tells about the other: the distribution of their distance.

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

from evedrop.kernels.elementary import Rows, cholesky, triangular_factor
from evedrop.model.numeric.factored import Factor
from evedrop.model.process import Floats, Process, product


@final
class Apart:
    """The distance to the twin, given one track of a slot; its numbers depend only on the process."""

    def __init__(self, start: Rows, noise: Rows) -> None:
        n = len(start)
        nothing = [0.0] * n
        above = [[*own, *late, *nothing] for own, late in zip(start, noise, strict=True)]
        below = [[*(-value for value in own), *nothing, *own] for own in start]
        joint = triangular_factor(above + below)
        self._state = [row[:n] for row in joint[:n]]
        self._gain = np.array([row[:n] for row in joint[n:]])
        self.factor = Factor.of_triangular([row[n:] for row in joint[n:]])
        """R_k, factored."""

    def mean(self, a: Floats) -> Floats:
        """G L_k⁻¹ a, (n, R), of tracks a (n, R)."""
        white = np.empty_like(a)
        for i, row in enumerate(self._state):
            rest = a[i]
            for j in range(i):
                rest = rest - row[j] * white[j]
            white[i] = rest / row[i]
        return product(self._gain, white)


@final
class Twins:
    """`Apart` of any slot; asking for slots in order is quick."""

    def __init__(self, process: Process) -> None:
        n = process.n
        self._A: Rows = process.A.tolist()
        self._noise: Rows = process.noise_factor.tolist()
        self._first = cholesky(process.initial_covariance).tolist(), [[0.0] * n for _ in range(n)]
        self._k = 0
        self._start, self._late = self._first

    def at(self, k: int) -> Apart:
        """The distance in slot k."""
        if k < self._k:
            self._k, (self._start, self._late) = 0, self._first
        while self._k < k:
            self._start = self._times_A(self._start)
            late = zip(self._times_A(self._late), self._noise, strict=True)
            self._late = triangular_factor([left + right for left, right in late])
            self._k += 1
        return Apart(self._start, self._late)

    def _times_A(self, rows: Rows) -> Rows:
        products: Rows = []
        for a in self._A:
            total = [a[0] * value for value in rows[0]]
            for weight, row in zip(a[1:], rows[1:], strict=True):
                total = [left + weight * right for left, right in zip(total, row, strict=True)]
            products.append(total)
        return products
