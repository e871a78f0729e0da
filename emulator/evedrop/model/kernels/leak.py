"""What an innovation packet tells about w_{k−1}, in numpy; `evedrop.model.theory.leak` says where the numbers come from."""

from __future__ import annotations

from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.kernels.elementary import Floats, product
from evedrop.model.kernels.factored import Factor, solved


@final
class Leak:
    """The leak of a slot k ≥ 1; its numbers depend only on the process.

    joint: [[L_k, 0], [QΣ_k⁻¹ L_k, M_k^½]], lower triangular, (2n, 2n).
    """

    def __init__(self, joint: Floats) -> None:
        n = len(joint) // 2
        self._state = joint[:n, :n].tolist()
        self._gain = joint[n:, :n]
        self._remaining = joint[n:, n:].tolist()

    def white(self, z: Floats) -> Floats:
        """L_k⁻¹ z, (n, R): white where z ~ N(0, Σ_k), which is the distribution of packets of both types."""
        return solved(self._state, z)

    def innovation(self, white: Floats) -> Floats:
        """The mean of w_{k−1} given the packet, QΣ_k⁻¹ z = QΣ_k⁻¹ L_k y, from y = L_k⁻¹ z, both (n, R)."""
        return product(self._gain, white)

    @cached_property
    def remaining(self) -> Floats:
        """M_k = Q − QΣ_k⁻¹Q, the covariance of w_{k−1} given the packet, (n, n)."""
        n = len(self._remaining)
        M = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for c in range(j + 1):
                    total += self._remaining[i][c] * self._remaining[j][c]
                M[i, j] = M[j, i] = total
        return M

    @cached_property
    def remaining_factor(self) -> Factor:
        """M_k, factored."""
        return Factor.of_triangular(self._remaining)

    @cached_property
    def state_diagonal(self) -> list[float]:
        """Squares of L_k's diagonal, (n,): their product is det Σ_k."""
        return [row[i] * row[i] for i, row in enumerate(self._state)]
