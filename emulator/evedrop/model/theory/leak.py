"""The information about w_{k−1} in an innovation packet, for a receiver that knows its type but not the noise that hides it.

z_k = w_{k−1} + χ_k with w ~ N(0, Q) and χ_k ~ N(0, A Σ_{k−1} Aᵀ), so given z_k the mean of w_{k−1} is QΣ_k⁻¹ z_k and its
covariance Q − QΣ_k⁻¹Q. One triangularisation gives everything, without a difference and without Σ_k, for singular Q too:

    [A L_{k−1}  Q^½]   [L_k          0       ]
    [0          Q^½] = [QΣ_k⁻¹ L_k   M_k^½   ] U,   U orthogonal, L_k L_kᵀ = Σ_k, M_k = Q − QΣ_k⁻¹Q.

Source: docs/mathematics/eavesdroppers.md, genie.
"""

from __future__ import annotations

import math
from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.kernels.mixtures import Leak
from evedrop.model.process import MARGINAL, Floats, Process, StateFactors, modulus_in, product
from evedrop.model.schedule import NoiseDistribution, state_factors
from evedrop.model.staircase import Staircase
from evedrop.model.streams import Ahead, BlockByBlock

_SLOTS_AT_ONCE, _NUMBERS_AT_ONCE = 64, 1 << 16  # read ahead of need
_AS_GOOD_AS_INFINITE = 1e60  # a standard deviation of the state, in those of the noise: its square is far from overflow


@final
class RemainingCovariances:
    """M_k, a number of slots at a time from k = 1, for the theory: beyond the horizon too, where Σ_k exceeds double precision."""

    def __init__(self, process: Process) -> None:
        self._A, self._noise = process.A, process.noise_factor
        self._carried = product(self._A, cholesky(process.initial_covariance))
        self._largest = _AS_GOOD_AS_INFINITE * float(np.abs(self._noise).max()) or math.inf
        growth = math.log(max(float(np.abs(self._A).sum(axis=1).max()), math.e))
        self._at_once = max(1, min(_SLOTS_AT_ONCE, int(math.log(_AS_GOOD_AS_INFINITE) / growth)))
        self._blocks = BlockByBlock(np.empty((0, *self._A.shape)), self._following)

    def next(self, slots: int) -> Floats:
        """M_k of the next slots, (slots, n, n)."""
        return self._blocks.next(slots)

    def _following(self) -> Floats:
        n, before = len(self._A), self._carried[None]
        carried = np.concatenate([before, kernels.carried_factors(self._A, self._noise, before[0], self._at_once)])
        # A column that is scaled down still means a variance that is as good as infinite, compared with which M_k is the same.
        self._carried = carried[-1] / np.maximum(1.0, np.abs(carried[-1]).max(axis=0) / self._largest)
        return _squared(_triangularised(carried[:-1], self._noise, self._noise)[:, n:, n:])


def remaining_limit(process: Process) -> Floats:
    """Limit of M_k, (n, n): Q minus the permanent leak in the directions in which the process is stable.

    With rows W of Aᵀ's stable invariant subspace, Wᵀx is a stable process by itself and the rest of Σ_k⁻¹ vanishes. M_k's
    limit is what the triangularisation above leaves, with Wᵀx in place of x. States that noise never reaches have no part in it.
    Raises ValueError as `Staircase` does.

    Source: docs/mathematics/eavesdroppers.md, genie; docs/mathematics/numerics.md, singular noise.
    """
    stairs = Staircase(process)
    if stairs.singular:
        reached, covariance = slice(stairs.unreached, None), np.zeros_like(process.Q)
        some = stairs.process
        covariance[reached, reached] = _remaining_limit(
            *(M[reached, reached] for M in (some.A, some.Q, some.noise_factor))
        )
        return stairs.outward_covariance(covariance[:, :, None])[:, :, 0]
    return _remaining_limit(process.A, process.Q, process.noise_factor)


def _remaining_limit(A: Floats, Q: Floats, noise: Floats) -> Floats:
    """The same if noise reaches all states; noise: a factor of Q."""
    from scipy.linalg import schur  # noqa: PLC0415 - slow to import

    modulus = modulus_in(A.T)
    T, Z, stable = schur(A.T, sort=lambda real, imaginary: modulus(real, imaginary) < 1.0 - MARGINAL)
    if stable == 0:
        return Q
    dynamics = T[:stable, :stable].T
    seen = Z[:, :stable].T @ noise
    joint = _triangularised((dynamics @ _stationary_factor(dynamics, seen))[None], seen, noise)
    limit: Floats = _squared(joint[:, stable:, stable:])[0]
    return limit


def _stationary_factor(F: Floats, G: Floats) -> Floats:
    """Lower triangular L with L Lᵀ = S, S = F S Fᵀ + G Gᵀ, by doubling: F (s, s) stable, G (s, m)."""
    L: Floats = kernels.triangular_factors(G[None])[0]
    power = F
    # The power is 0 in the end: F is stable.
    while not np.array_equal(grown := kernels.triangular_factors(np.concatenate([L, power @ L], axis=1)[None])[0], L):
        L, power = grown, power @ power
    return L


def _triangularised(carried: Floats, seen: Floats, noise: Floats) -> Floats:
    """The triangular matrices above, (c, s + n, s + n).

    carried: A L_{k−1}, (c, s, s); seen: the factor of what the noise adds to the state, (s, n); noise: Q^½, (n, n).
    """
    s, n = seen.shape
    joint = np.zeros((len(carried), s + n, s + n))
    joint[:, :s, :s] = carried
    joint[:, :s, s:], joint[:, s:, s:] = seen, noise
    return kernels.triangular_factors(joint)


def _squared(L: Floats) -> Floats:
    """L Lᵀ, (c, n, n), of L (c, n, n)."""
    return np.asarray(L @ L.swapaxes(1, 2))


@final
class Leaks:
    """The leak of every slot k ≥ 1; reading slots in order computes each once, and many at a time.

    distribution: of noise that is sent in place of innovations, and leaks nothing: L_k is then the factor of its covariance, and
    M_k is Q. Raises ValueError as `Staircase` does.
    """

    def __init__(self, process: Process, distribution: NoiseDistribution | None = None) -> None:
        self.stairs = Staircase(process)
        """The coordinates of all leaks: where Q is singular they are not those of x."""
        process = self.stairs.process
        self._states = StateFactors(process)
        self._alone = None if distribution is None else self.stairs.inward_distribution(distribution).factors(process)
        self._sizes = None if distribution is None else state_factors(process)
        self._noise = process.noise_factor
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

    def rounding(self, slots: range) -> Floats:
        """The variance of the rounding of packets, (c, n), in the coordinates of leaks; 0 if Q is nonsingular."""
        n = len(self._noise)
        if not self.stairs.singular:
            return np.zeros((len(slots), n))
        return self.stairs.rounding(self.block(slots)[:, :n, :n] if self._sizes is None else self._sizes(slots))

    def _computed(self, slots: range) -> Floats:
        if self._alone is None:
            return _triangularised(self._states.block(slots), self._noise, self._noise)
        n = len(self._noise)
        joint = np.zeros((len(slots), 2 * n, 2 * n))
        joint[:, :n, :n], joint[:, n:, n:] = self._alone(slots), self._noise
        return joint
