"""The information about w_{k−1} in an innovation packet, for a receiver that knows its type but not the noise that hides it.

z_k = w_{k−1} + χ_k with w ~ N(0, Q) and χ_k ~ N(0, A Σ_{k−1} Aᵀ), so given z_k the mean of w_{k−1} is QΣ_k⁻¹ z_k and its
covariance Q − QΣ_k⁻¹Q. One triangularisation gives everything, without a difference and without Σ_k:

    [A L_{k−1}  Q^½]   [L_k          0       ]
    [0          Q^½] = [QΣ_k⁻¹ L_k   M_k^½   ] U,   U orthogonal, L_k L_kᵀ = Σ_k, M_k = Q − QΣ_k⁻¹Q.

Source: docs/mathematics.md, genie.
"""

from __future__ import annotations

import math
from typing import final

import numpy as np

from evedrop.kernels.current import kernels
from evedrop.kernels.elementary import cholesky
from evedrop.kernels.leak import Leak
from evedrop.model.process import MARGINAL, Floats, Process, StateFactors
from evedrop.streams import Ahead

_SLOTS_AT_ONCE, _NUMBERS_AT_ONCE = 64, 1 << 16  # read ahead of need


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
    """The leak of every slot k ≥ 1; reading slots in order computes each once, and many at a time."""

    def __init__(self, process: Process) -> None:
        self._states = StateFactors(process)
        self._noise = cholesky(process.Q)
        count = max(1, min(_SLOTS_AT_ONCE, _NUMBERS_AT_ONCE // (4 * process.n * process.n)))
        self._factors = Ahead(lambda slots: range(slots.start, max(slots.stop, slots.start + count)), self._computed)
        self._k = 0
        self._leak: Leak

    def at(self, k: int) -> Leak:
        """The leak of slot k."""
        if k != self._k:
            self._k, self._leak = k, Leak(self.block(range(k, k + 1))[0])
        return self._leak

    def block(self, slots: range) -> Floats:
        """The triangular matrices of consecutive slots, at least one, (c, 2n, 2n); that of slot 0 has no meaning."""
        return self._factors.of(slots)

    def _computed(self, slots: range) -> Floats:
        n = len(self._noise)
        joint = np.zeros((len(slots), 2 * n, 2 * n))
        joint[:, :n, :n] = self._states.block(slots)
        joint[:, :n, n:] = joint[:, n:, n:] = self._noise
        return kernels.triangular_factors(joint)
