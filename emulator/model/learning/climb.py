"""Expectation-maximisation over all slots that an eavesdropper has kept, from several starts at once.

The starts are further columns beside the trials: a trial has one for each start, and in the end keeps the most likely one.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evedrop.kernels.elementary import Floats
from evedrop.kernels.factored import Factors, orthogonalised
from evedrop.kernels.mixtures import Mixture
from evedrop.model.learning.moments import Moments
from evedrop.model.learning.posterior import Parameters, Transition, begun, nothing, weighed
from evedrop.model.receiver import Flags

CAPACITY = 6
"""The most components of a trial's posterior."""
PASSES = 8
"""Passes over the slots that were kept, whenever they are gone through."""
NARROW = (0.1, 0.01, 1e-4)
"""The starts' Q, over the variance of the first packets, each with A = I."""
_EARLY = 4  # packets whose mean square is the scale of all


@dataclass(frozen=True)
class Known:
    """What an eavesdropper knows of the process, and what it takes in place of the rest."""

    names: frozenset[str]
    """Those of A, Q, mu_d and initial_covariance that it knows."""
    A: Floats
    """(n, n); I if it is not known."""
    noise: Factors
    """Q, of one matrix, (1,) matrices; anything if it is not known."""
    mu_d: float
    """1/2 if it is not known."""
    initial: Factors
    """Σ0, as Q; the variance of the first packets replaces it if it is not known."""

    @property
    def sigma(self) -> bool:
        """Whether it knows Σ_k of every slot."""
        return self.names >= {"A", "Q", "initial_covariance"}

    @property
    def everything(self) -> bool:
        """Whether it has nothing to learn."""
        return self.names >= {"A", "Q", "mu_d"}

    def start(self, variance: Floats) -> Parameters:
        """The parameters that are known, and where they are not A = I, a Q of some variance (R,), and μ_d = 1/2."""
        trials = len(variance)
        noise = Factors(*(np.repeat(part, trials, axis=-1) for part in self.noise))
        if "Q" not in self.names:
            noise = Factors(np.zeros_like(noise.lower), np.repeat(variance[None], len(noise.diagonal), axis=0))
        return Parameters(np.repeat(self.A[:, :, None], trials, axis=2), *noise, np.full(trials, self.mu_d))


class Course(NamedTuple):
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


class Advanced(NamedTuple):
    """A slot's result."""

    course: Course
    state: Floats
    """Probability that the packet is the state, (R,)."""
    evidence: Floats
    """Logarithm of the packet's density, (R,)."""
    last: Transition
    """The transition to the slot; of no component in slot 0."""


def unheard(known: Known, scale: Floats) -> Course:
    """The posterior before the first packet; scale: a variance, (R,), for want of Σ0."""
    n, trials = len(known.A), len(scale)
    sigma = Factors(*(np.repeat(part, trials, axis=-1) for part in known.initial))
    if "initial_covariance" not in known.names:
        sigma = Factors(np.zeros_like(sigma.lower), np.repeat(scale[None], n, axis=0))
    one = Mixture(np.ones((1, trials)), np.zeros((n, 1, trials)), *(part[:, None, :].copy() for part in sigma))
    return Course(*one, *sigma, np.zeros(trials))


def advanced(k: int, known: Known, theta: Parameters, course: Course, gamma: Flags, z: Floats) -> Advanced:
    """The posterior after slot k; gamma (R,); z (n, R), 0 where nothing was received."""
    mixture, sigma, packets = course.mixture, course.sigma, course.packets
    evidence, last = np.zeros(len(gamma)), nothing(*z.shape)
    if k:
        mixture, sigma, evidence, state, last = weighed(theta, sigma, mixture, gamma, z, CAPACITY)
    else:
        mixture, state = begun(mixture, gamma, z, CAPACITY)
    if not known.sigma:
        sigma = _corrected(sigma, packets, gamma, z)
    return Advanced(Course(*mixture, *sigma, packets + gamma), state, evidence, last)


def _corrected(sigma: Factors, packets: Floats, gamma: Flags, z: Floats) -> Factors:
    """Σ_k, drawn towards z zᵀ by the packets so far (R,): both types have this covariance. The first packet gives its scale."""
    n, first = len(z), gamma & (packets == 0.0)
    share = np.where(gamma & ~first, 1.0 / (packets + n + 1.0), 0.0)
    rows = [[*row, value] for row, value in zip(sigma.unit(), z, strict=True)]
    drawn = orthogonalised(rows, [*(sigma.diagonal * (1.0 - share)), share])
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


class Learned(NamedTuple):
    """The result of a climb."""

    course: Course
    theta: Parameters
    moments: Moments
    scale: Floats
    """(R,)."""


def climbed(known: Known, first: int, gamma: Flags, z: Floats, so_far: Parameters | None) -> Learned:
    """The most likely parameters for slots from `first` on, gamma (c, R) and z (c, n, R), 0 where nothing was received.

    so_far: the parameters that were found from fewer slots, which are one more start.
    """
    scale = scale_of(gamma, z)
    # The regression that takes every packet for the state: its A has the right direction, and is too small.
    start = known.start(scale)
    every = start._replace(mu_d=np.ones_like(scale))
    _, moments, _ = _passed(known, every, first, gamma, z, scale)
    regression = moments.most_likely(every, scale, known.names)[1]._replace(mu_d=start.mu_d)
    starts = [regression, *(known.start(share * scale) for share in NARROW), *([so_far] if so_far else [])]
    several, trials = len(starts), len(scale)
    theta = Parameters(*(np.concatenate(parts, axis=-1) for parts in zip(*starts, strict=True)))
    gamma, z, scales = (np.concatenate([part] * several, axis=-1) for part in (gamma, z, scale))
    for _ in range(PASSES):
        course, moments, evidence = _passed(known, theta, first, gamma, z, scales)
        moments, theta = moments.most_likely(theta, scales, known.names)
    best = np.argmax(evidence.reshape(several, trials), axis=0) * trials + np.arange(trials)
    return Learned(
        Course(*(part[..., best] for part in course)),
        Parameters(*(part[..., best] for part in theta)),
        Moments(*(part[..., best] for part in moments)),
        scale,
    )


def _passed(
    known: Known, theta: Parameters, first: int, gamma: Flags, z: Floats, scale: Floats
) -> tuple[Course, Moments, Floats]:
    """The posterior after the slots from `first` on, the moments of their transitions, and the logarithm of their density."""
    course, moments = unheard(known, scale), Moments.imagined(theta.A, scale)
    evidence = np.zeros(len(scale))
    for k, (heard, packet) in enumerate(zip(gamma, z, strict=True), first):
        course, _, density, last = advanced(k, known, theta, course, heard, packet)
        evidence = evidence + density
        if k:
            moments = moments.added(theta.A, packet, heard.astype(np.float64), last)
    return course, moments, evidence
