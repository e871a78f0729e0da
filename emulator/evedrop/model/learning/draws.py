"""Random parameters: the first particles, which all trials share, and draws given the moments of a particle's transitions.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

import math

import numpy as np

from evedrop.model.kernels.elementary import Floats, exp, log, normal_quantile
from evedrop.model.kernels.factored import Factors
from evedrop.model.learning.known import Known
from evedrop.model.learning.moments import Moments, applied_factors, backwards
from evedrop.model.learning.posterior import Parameters

_SPREAD = 0.3  # standard deviation of the first particles' entries of A
_LEAST_LOG = -9.210340371976182  # log of the least Q of the first particles, over the packets' variance: 10⁻⁴
_LEAST_ROOT = 0.3  # of the cube root of a χ² variable over its mean: not below


def numbers_of(n: int) -> int:
    """The normal numbers that a draw takes: for A, for the factors of Q, and for μ_d."""
    return n * n + n * (n - 1) // 2 + n + 1


def lattice(known: Known, particles: int) -> Parameters:
    """The first particles, in units of the packets' variance: A around I, Q over decades, every μ_d; (…, N).

    Fractional parts of multiples of square roots of primes: evenly spread, and the same in all trials.
    """
    n = len(known.A)
    place = np.arange(1.0, particles + 1.0)
    spread: list[Floats] = [(place * math.sqrt(prime)) % 1.0 for prime in _primes(n * n + 2)]
    theta = known.start(np.ones(particles))
    if "A" not in known.names:
        normals = normal_quantile(np.clip(np.array(spread[: n * n]), 1e-6, 1.0 - 1e-6))
        theta = theta._replace(A=theta.A + _SPREAD * normals.reshape(n, n, particles))
    if "Q" not in known.names:
        theta = theta._replace(diagonal=theta.diagonal * exp(_LEAST_LOG * spread[-2]))
    if "mu_d" not in known.names:
        theta = theta._replace(mu_d=np.clip(spread[-1], 0.02, 0.98))
    return theta


def _primes(count: int) -> list[int]:
    found: list[int] = []
    candidate = 2
    while len(found) < count:
        if all(candidate % prime for prime in found):
            found.append(candidate)
        candidate += 1
    return found


def drawn(
    moments: Moments, theta: Parameters, scale: Floats, known: Known, normals: Floats
) -> tuple[Moments, Parameters]:
    """Parameters given the moments, and the moments about the new A; normals: (numbers_of(n), R).

    A | Q is normal about the regression's with the covariance Q ⊗ H⁻¹; the D of Q are scaled by χ² variables over their
    means, and μ_d by a normal change of its logit.
    """
    n = len(theta.A)
    fitted, best = moments.most_likely(theta, scale, known.names)
    lower, diagonal, mu_d = best.lower, best.diagonal, best.mu_d
    freedom = moments.transitions + 1.0
    if "Q" not in known.names:
        root = 1.0 - 2.0 / (9.0 * freedom) + normals[n * n : n * n + n] * np.sqrt(2.0 / (9.0 * freedom))
        root = np.maximum(root, _LEAST_ROOT)
        pairs = [(i, j) for i in range(n) for j in range(i)]
        ratios = [np.sqrt(diagonal[i] / (diagonal[j] * freedom)) for i, j in pairs]
        if ratios:
            lower = lower + np.stack(ratios) * normals[n * n + n : -1]
        diagonal = diagonal / (root * root * root)
    A = best.A
    if "A" not in known.names:
        white = normals[: n * n].reshape(n, n, -1) / np.sqrt(fitted.diagonal)
        A = A + backwards(applied_factors(Factors(lower, diagonal), white), fitted.information)
    if "mu_d" not in known.names:
        counts = moments.packets * mu_d * (1.0 - mu_d)
        logit = log(mu_d / (1.0 - mu_d)) + normals[-1] / np.sqrt(counts)
        mu_d = 1.0 / (1.0 + exp(-np.clip(logit, -30.0, 30.0)))
    return fitted.about(A - best.A), Parameters(A, lower, diagonal, mu_d)
