"""The posterior of a learning eavesdropper from slot to slot, with Σ_k as estimated from the packets.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evedrop.model.kernels.elementary import Floats
from evedrop.model.kernels.factored import Factors, orthogonalised
from evedrop.model.kernels.mixtures import Mixture
from evedrop.model.learning.known import Known
from evedrop.model.learning.posterior import Parameters, Transition, begun, nothing, weighed
from evedrop.model.receiver import Flags

CAPACITY = 6
"""The most components of a trial's posterior."""
_EARLY = 4  # packets whose mean square is the scale of all
_FARTHEST = (
    4.0  # times the largest packet: no state and no standard deviation is taken to be larger, because A may be wrong
)


class LearnerPosterior(NamedTuple):
    """The posterior of a slot."""

    weight: Floats
    """The mixture, as in `Mixture`, (C, R)."""
    mean: Floats
    """(n, C, R)."""
    lower: Floats
    """(n (n−1)/2, C, R)."""
    diagonal: Floats
    """(n, C, R)."""
    sigma_lower: Floats
    """The factors of Σ_k as estimated, (n (n−1)/2, R)."""
    sigma_diagonal: Floats
    """(n, R)."""
    packets: Floats
    """Packets heard, (R,)."""

    @property
    def mixture(self) -> Mixture:
        """The distribution of the state."""
        return Mixture(*self[:4])

    @property
    def sigma(self) -> Factors:
        """Σ_k as estimated."""
        return Factors(self.sigma_lower, self.sigma_diagonal)

    def knowing(self, x: Floats) -> LearnerPosterior:
        """The posterior once the slot's state x, (n, R), is known: one component, with covariance 0."""
        n, trials = x.shape
        none = np.zeros((n * (n - 1) // 2, 1, trials)), np.zeros((n, 1, trials))
        return LearnerPosterior(np.ones((1, trials)), x[:, None, :], *none, *self[4:])


class Advanced(NamedTuple):
    """A slot's result."""

    posterior: LearnerPosterior
    state: Floats
    """Probability that the packet is the state, (R,)."""
    evidence: Floats
    """Logarithm of the packet's density, (R,)."""
    last: Transition
    """The transition to the slot; of no component in slot 0."""


def unheard(known: Known, scale: Floats) -> LearnerPosterior:
    """The posterior before the first packet; scale: a variance, (R,), for want of Σ0."""
    n, trials = len(known.A), len(scale)
    sigma = Factors(*(np.repeat(part, trials, axis=-1) for part in known.initial))
    if "initial_covariance" not in known.names:
        sigma = Factors(np.zeros_like(sigma.lower), np.repeat(scale[None], n, axis=0))
    one = Mixture(np.ones((1, trials)), np.zeros((n, 1, trials)), *(part[:, None, :].copy() for part in sigma))
    return LearnerPosterior(*one, *sigma, np.zeros(trials))


def advanced(k: int, known: Known, theta: Parameters, posterior: LearnerPosterior, gamma: Flags, z: Floats) -> Advanced:
    """The posterior after slot k; gamma (R,); z (n, R), 0 where nothing was received."""
    mixture, sigma, packets = posterior.mixture, posterior.sigma, posterior.packets
    evidence, last = np.zeros(len(gamma)), nothing(*z.shape)
    if k:
        mixture, sigma, evidence, state, last = weighed(theta, sigma, mixture, gamma, z, CAPACITY)
    else:
        mixture, state = begun(mixture, gamma, z, CAPACITY)
    if not known.sigma:
        sigma = _corrected(sigma, packets, gamma, z)
    return Advanced(LearnerPosterior(*mixture, *sigma, packets + gamma), state, evidence, last)


def _corrected(sigma: Factors, packets: Floats, gamma: Flags, z: Floats) -> Factors:
    """Σ_k, drawn towards z zᵀ by the packets so far (R,): both types have this covariance. The first packet gives its scale."""
    n, first = len(z), gamma & (packets == 0.0)
    fraction = np.where(gamma & ~first, 1.0 / (packets + n + 1.0), 0.0)
    rows = [[*row, value] for row, value in zip(sigma.unit(), z, strict=True)]
    drawn = orthogonalised(rows, [*(sigma.diagonal * (1.0 - fraction)), fraction])
    return Factors(np.where(first, 0.0, drawn.lower), np.where(first, scale_of(gamma[None], z[None]), drawn.diagonal))


def scale_of(gamma: Flags, z: Floats) -> Floats:
    """The mean square of a state in the first packets that were heard, (R,); 1 without any; gamma (c, R), z (c, n, R)."""
    count, total = np.zeros(z.shape[-1]), np.zeros(z.shape[-1])
    for heard, packet in zip(gamma, z, strict=True):
        early = heard & (count < _EARLY)
        for row in packet:
            total = total + np.where(early, row * row, 0.0)
        count = count + early
    return np.where(total > 0.0, total / np.maximum(count * z.shape[1], 1.0), 1.0)


def bounded(x_hat: Floats, P: Floats, largest: Floats) -> tuple[Floats, Floats]:
    """A mean (n, R) and a covariance (n, n, R), made smaller where they are out of all proportion to the packets.

    largest: the largest |z| of every state so far, (n, R).
    """
    bound = np.where(largest > 0.0, _FARTHEST * largest, 1e100)
    standard_deviation = np.sqrt(np.stack([P[i, i] for i in range(len(P))]))
    fraction = np.where(standard_deviation > bound, bound / np.maximum(standard_deviation, bound), 1.0)
    return np.clip(x_hat, -bound, bound), P * (fraction[:, None] * fraction[None])
