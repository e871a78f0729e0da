"""The information about w_{k−1} in an innovation packet, for a receiver that knows its type but not the noise that hides it.

z_k = w_{k−1} + χ_k with w ~ N(0, Q) and χ_k ~ N(0, A Σ_{k−1} Aᵀ), so given z_k the mean of w_{k−1} is QΣ_k⁻¹ z_k and its
covariance Q − QΣ_k⁻¹Q. One triangularisation gives everything, without a difference and without Σ_k:

    [A L_{k−1}  Q^½]   [L_k          0       ]
    [0          Q^½] = [QΣ_k⁻¹ L_k   M_k^½   ] U,   U orthogonal, L_k L_kᵀ = Σ_k, M_k = Q − QΣ_k⁻¹Q.

Source: docs/mathematics.md, genie.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import final

import numpy as np

from evedrop.kernels.elementary import Rows, cholesky, triangular_factor
from evedrop.model.numeric.factored import Factor
from evedrop.model.process import MARGINAL, Floats, Process, StateFactors, product


@final
class Leak:
    """The leak of a slot k ≥ 1; its numbers depend only on the process."""

    def __init__(self, carried: Rows, noise: Rows) -> None:
        n = len(noise)
        above = [left + right for left, right in zip(carried, noise, strict=True)]
        below = [[0.0] * n + right for right in noise]
        joint = triangular_factor(above + below)
        self._state = [row[:n] for row in joint[:n]]
        self._gain = np.array([row[:n] for row in joint[n:]])
        self._remaining = [row[n:] for row in joint[n:]]

    def white(self, z: Floats) -> Floats:
        """L_k⁻¹ z, (n, R): white where z ~ N(0, Σ_k), which is the distribution of packets of both types."""
        y = np.empty_like(z)
        for i, row in enumerate(self._state):
            rest = z[i]
            for j in range(i):
                rest = rest - row[j] * y[j]
            y[i] = rest / row[i]
        return y

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


@final
class RemainingCovariances:
    """M_k for k = 1, 2, … in this order, for the theory: fast, and accurate to the rounding of Q, but bits depend on the machine.

    From M_k = A (Σ_{k−1}⁻¹ + AᵀQ⁻¹A)⁻¹ Aᵀ and Σ_k⁻¹ = Q⁻¹ − Q⁻¹M_kQ⁻¹, which work even where Σ_k cannot be inverted.
    """

    def __init__(self, process: Process) -> None:
        self._A = process.A
        self._precision = np.linalg.inv(process.Q)
        self._carried = process.A.T @ self._precision @ process.A
        self._information = np.linalg.inv(process.initial_covariance)

    def next(self) -> Floats:
        """M_k of the next slot, (n, n)."""
        M: Floats = self._A @ np.linalg.inv(self._information + self._carried) @ self._A.T
        self._information = self._precision - self._precision @ M @ self._precision
        return M


def remaining_limit(process: Process) -> Floats:
    """Limit of M_k, (n, n): Q minus the permanent leak in the directions in which the process is stable.

    With rows W of Aᵀ's stable invariant subspace, Wᵀx is a stable process by itself and the rest of Σ_k⁻¹ vanishes.

    Source: docs/mathematics.md, genie.
    """
    from scipy.linalg import schur, solve_discrete_lyapunov  # noqa: PLC0415 - slow to import

    T, Z, stable = schur(process.A.T, sort=lambda real, imaginary: math.hypot(real, imaginary) < 1.0 - MARGINAL)
    if stable == 0:
        return process.Q
    W = Z[:, :stable]
    S = solve_discrete_lyapunov(T[:stable, :stable].T, W.T @ process.Q @ W)
    limit: Floats = process.Q - process.Q @ W @ np.linalg.solve(S, W.T @ process.Q)
    return limit


@final
class Leaks:
    """The leak of every slot k ≥ 1; reading slots in order computes each once."""

    def __init__(self, process: Process) -> None:
        self._states = StateFactors(process)
        self._noise: Rows = cholesky(process.Q).tolist()
        self._k = 0
        self._leak: Leak

    def at(self, k: int) -> Leak:
        """The leak of slot k."""
        if k != self._k:
            self._k, self._leak = k, Leak(self._states.carried(k), self._noise)
        return self._leak
