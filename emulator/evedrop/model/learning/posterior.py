"""The Bayesian eavesdropper's posterior of the state and of the last transition, where every trial has its own A, Q, Σ and μ_d.

The formulas are those of `evedrop.model.kernels.posterior`, whose A and Q are the same in all trials.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evedrop.model.kernels.elementary import Floats, exp, log
from evedrop.model.kernels.factored import Entry, Factors, orthogonalised, squared_length
from evedrop.model.kernels.mixtures import Mixture, opened, pruned, summed
from evedrop.model.receiver import Flags

_CERTAIN = 300.0  # an exponent at which a packet is certainly the state, still far from overflow
_IMPOSSIBLE = -700.0  # an exponent at which it certainly is not, still far from underflow
_SURE = 1e300  # stands for all larger odds
_LEAST = 1e-300  # stands for all smaller densities
_LARGEST = 1e60
"""The largest mean, and the square root of the largest variance: a learned A may be far too large. Squares stay finite."""


class Parameters(NamedTuple):
    """θ of R trials."""

    A: Floats
    """(n, n, R)."""
    lower: Floats
    """The factors of Q, (n (n−1)/2, R)."""
    diagonal: Floats
    """(n, R)."""
    mu_d: Floats
    """(R,)."""

    @property
    def noise(self) -> Factors:
        """Q, factored."""
        return Factors(self.lower, self.diagonal)


class Transition(NamedTuple):
    """The knowledge of x_{k−1} if the packet of slot k is the state x_k, for each component of slot k − 1."""

    fraction: Floats
    """Probability of the component and that the packet is the state, (C, R)."""
    before: Floats
    """Mean of x_{k−1}, (n, C, R)."""
    spread: Factors
    """Covariance of x_{k−1}, (C, R) matrices."""


class Weighed(NamedTuple):
    """The result of a slot."""

    mixture: Mixture
    """After the slot."""
    sigma: Factors
    """Σ_k = A Σ_{k−1} Aᵀ + Q, (R,) matrices."""
    evidence: Floats
    """Logarithm of the packet's density, without the constant, (R,); 0 where nothing was received."""
    state: Floats
    """Probability that the packet is the state, (R,); 0 where nothing was received."""
    last: Transition
    """The transition to slot k."""


def nothing(n: int, trials: int) -> Transition:
    """The transition of no component."""
    return Transition(
        np.zeros((0, trials)),
        np.zeros((n, 0, trials)),
        Factors(np.zeros((n * (n - 1) // 2, 0, trials)), np.zeros((n, 0, trials))),
    )


def begun(of: Mixture, gamma: Flags, z: Floats, capacity: int) -> tuple[Mixture, Floats]:
    """The mixture after slot 0, in which every packet is the state, and the probability of that, (R,).

    gamma (R,); z (n, R), 0 where nothing was received.
    """
    state = gamma.astype(np.float64)
    of = Mixture(np.where(gamma, 0.0, of.weight), *(part.copy() for part in of[1:]))
    return opened(pruned(of), state, z, capacity), state


def weighed(theta: Parameters, sigma: Factors, of: Mixture, gamma: Flags, z: Floats, capacity: int) -> Weighed:
    """The mixture one slot later, for k ≥ 1.

    sigma: Σ_{k−1}; gamma (R,); z (n, R), 0 where nothing was received; capacity: the most components.
    """
    sigma, told, remaining = _leak(theta, sigma)
    carried, noise = _carried(theta.A, of.spread), theta.noise.unit()
    of_noise, of_remaining = (_over(part.diagonal, of.weight) for part in (theta.noise, remaining))
    joint = orthogonalised(
        _beside(carried, noise) + _beside(of.spread.unit(), _zero(len(z))), [*of.diagonal, *of_noise]
    )
    predicted, gain, spread = _parts(joint)
    informed = orthogonalised(_beside(carried, remaining.unit()), [*of.diagonal, *of_remaining])
    mean = np.clip(_times(theta.A, of.mean), -_LARGEST, _LARGEST)
    away, alone = z[:, None, :] - mean, squared_length(sigma, list(z))
    ratios = np.where(gamma, of.weight * _likely(away, predicted, alone, sigma), 0.0)
    ratio = summed(ratios)
    state = _state_probability(theta.mu_d, ratio, gamma)
    fraction = np.divide(ratios, ratio, out=np.zeros(ratios.shape), where=ratio > 0.0) * state
    before = of.mean + _entries(gain, _whitened(predicted, away))
    mean = np.where(gamma, mean + _entries(told, _whitened(sigma, z))[:, None, :], mean)
    after = Mixture(
        of.weight * (1.0 - state), mean, *(np.where(gamma, *pair) for pair in zip(informed, predicted, strict=True))
    )
    after = after._replace(diagonal=np.minimum(after.diagonal, _LARGEST * _LARGEST))
    density = log(np.maximum(theta.mu_d * ratio + (1.0 - theta.mu_d), _LEAST)) - 0.5 * (alone + _log_determinant(sigma))
    mixture = opened(pruned(after), state, z, capacity)
    return Weighed(mixture, sigma, np.where(gamma, density, 0.0), state, Transition(fraction, before, spread))


def _leak(theta: Parameters, sigma: Factors) -> tuple[Factors, list[list[Floats]], Factors]:
    """Σ_k, the matrix QΣ_k⁻¹ U_k as entries, and M_k, from Σ_{k−1}; see `evedrop.model.theory.leak`."""
    noise = theta.noise.unit()
    rows = _beside(_carried(theta.A, sigma), noise) + _beside(_zero(len(noise)), noise)
    new, told, remaining = _parts(orthogonalised(rows, [*sigma.diagonal, *theta.noise.diagonal]))
    return Factors(new.lower, np.minimum(new.diagonal, _LARGEST * _LARGEST)), told, remaining


def _likely(away: Floats, predicted: Factors, alone: Floats, sigma: Factors) -> Floats:
    """N(z; m_j, P_j) / N(z; 0, Σ_k), (C, R); away: z − m_j, (n, C, R); alone: zᵀ Σ_k⁻¹ z, (R,)."""
    exponent = alone - squared_length(predicted, list(away)) + _log_determinant(sigma) - _log_determinant(predicted)
    return exp(np.clip(0.5 * exponent, _IMPOSSIBLE, _CERTAIN))


def _log_determinant(P: Factors) -> Floats:
    """Log det P of many matrices."""
    total: Floats = log(P.diagonal[0])
    for D in P.diagonal[1:]:
        total = total + log(D)
    return total


def _state_probability(mu_d: Floats, ratio: Floats, gamma: Flags) -> Floats:
    """Probability that the packet is the state, (R,); ratio: of its densities under the two types, (R,)."""
    sure = mu_d == 1.0
    odds = np.minimum(mu_d / np.where(sure, 1.0, 1.0 - mu_d) * ratio, _SURE)
    return np.where(gamma, np.where(sure, 1.0, odds / (1.0 + odds)), 0.0)


def _carried(A: Floats, P: Factors) -> list[list[Entry]]:
    """A U as rows of entries, from the factors U D Uᵀ of many matrices; A (n, n, R)."""
    n, U = len(A), P.unit()
    found: list[list[Entry]] = [[A[i, j] for j in range(n)] for i in range(n)]  # U's diagonal is 1
    for i, row in enumerate(found):
        for j in range(n):
            for c in range(j + 1, n):
                row[j] = row[j] + A[i, c] * U[c][j]
    return found


def _parts(joint: Factors) -> tuple[Factors, list[list[Floats]], Factors]:
    """The factors of (2n, 2n) matrices in parts: those of the first block, the block of U below it, those of the remainder."""
    n = len(joint.diagonal) // 2
    starts = [i * (i - 1) // 2 for i in range(2 * n)]
    below = [list(joint.lower[start : start + n]) for start in starts[n:]]
    last = [joint.lower[start + n : start + n + i] for i, start in enumerate(starts[n:])]
    return (
        Factors(joint.lower[: starts[n]], joint.diagonal[:n]),
        below,
        Factors(np.concatenate(last), joint.diagonal[n:]),
    )


def _whitened(P: Factors, z: Floats) -> Floats:
    """U⁻¹ z, (n, …)."""
    found: list[Floats] = []
    for row, value in zip(P.unit(), z, strict=True):
        rest = value
        for factor, earlier in zip(row, found, strict=False):
            rest = rest - factor * earlier
        found.append(rest)
    return np.stack(found)


def _beside(left: list[list[Entry]], right: list[list[Entry]]) -> list[list[Entry]]:
    """The rows of [left right]."""
    return [[*one, *other] for one, other in zip(left, right, strict=True)]


def _zero(n: int) -> list[list[Entry]]:
    """The matrix 0."""
    return [[0.0] * n for _ in range(n)]


def _over(values: Floats, weight: Floats) -> Floats:
    """(n, R) numbers of trials as those of their components, (n, C, R)."""
    return np.broadcast_to(values[:, None, :], (len(values), *weight.shape))


def _times(A: Floats, x: Floats) -> Floats:
    """A x of the components of every trial: A (n, n, R), x (n, C, R)."""
    found: Floats = A[:, 0, None, :] * x[0]
    for j in range(1, len(x)):
        found = found + A[:, j, None, :] * x[j]
    return found


def _entries(M: list[list[Floats]], x: Floats) -> Floats:
    """M x, from the entries of M, each of the shape that x has after its first axis."""
    found = []
    for row in M:
        total = row[0] * x[0]
        for entry, value in zip(row[1:], x[1:], strict=True):
            total = total + entry * value
        found.append(total)
    return np.stack(found)
