"""The eavesdropper that learns by a particle filter: many candidates for A, Q and μ_d, each with its Bayesian eavesdropper.

Its first particles are random parameters that all trials share; later ones are drawn given the moments of a particle's
transitions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.checks import whole_number_mistakes
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.eavesdroppers.learner import (
    Known,
    Learner,
    LearnerPosterior,
    Moments,
    Parameters,
    advanced,
    applied_factors,
    backwards,
    knowing_mistakes,
    scale_of,
    unheard,
)
from evedrop.model.kernels.elementary import exp, log, normal_quantile
from evedrop.model.kernels.factored import Factors, covariance
from evedrop.model.kernels.mixtures import moments as moments_of
from evedrop.model.kernels.mixtures import summed
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Codes, Flags, Reception, read_actions
from evedrop.model.streams import Batch, BlockReader

_SPREAD = 0.3  # standard deviation of the first particles' entries of A
_LEAST_LOG = -9.210340371976182  # log of the least Q of the first particles, over the packets' variance: 10⁻⁴
_LEAST_ROOT = 0.3  # of the cube root of a χ² variable over its mean: not below


def numbers_of(n: int) -> int:
    """The normal numbers that a draw takes: for A, for the factors of Q, and for μ_d."""
    return n * n + n * (n - 1) // 2 + n + 1


def lattice(given: Known, particles: int) -> Parameters:
    """The first particles, in units of the packets' variance: A around I, Q over decades, every μ_d; (…, N).

    Fractional parts of multiples of square roots of primes: evenly spread, and the same in all trials.
    """
    n = len(given.A)
    place = np.arange(1.0, particles + 1.0)
    spread: list[Floats] = [(place * math.sqrt(prime)) % 1.0 for prime in _primes(n * n + 2)]
    theta = given.start(np.ones(particles))
    if "A" not in given.names:
        normals = normal_quantile(np.clip(np.array(spread[: n * n]), 1e-6, 1.0 - 1e-6))
        theta = theta._replace(A=theta.A + _SPREAD * normals.reshape(n, n, particles))
    if "Q" not in given.names:
        theta = theta._replace(diagonal=theta.diagonal * exp(_LEAST_LOG * spread[-2]))
    if "mu_d" not in given.names:
        theta = theta._replace(mu_d=np.clip(spread[-1], 0.02, 0.98))
    return theta


def _primes(count: int) -> list[int]:
    primes: list[int] = []
    candidate = 2
    while len(primes) < count:
        if all(candidate % prime for prime in primes):
            primes.append(candidate)
        candidate += 1
    return primes


def drawn(
    moments: Moments, theta: Parameters, scale: Floats, given: Known, normals: Floats
) -> tuple[Moments, Parameters]:
    """Parameters given the moments, and the moments about the new A; normals: (numbers_of(n), R).

    A | Q is normal about the regression's with the covariance Q ⊗ H⁻¹; the D of Q are scaled by χ² variables over their
    means, and μ_d by a normal change of its logit.
    """
    n = len(theta.A)
    fitted, best = moments.most_likely(theta, scale, given.names)
    lower, diagonal, mu_d = best.lower, best.diagonal, best.mu_d
    freedom = moments.transitions + 1.0
    if "Q" not in given.names:
        root = 1.0 - 2.0 / (9.0 * freedom) + normals[n * n : n * n + n] * np.sqrt(2.0 / (9.0 * freedom))
        root = np.maximum(root, _LEAST_ROOT)
        pairs = [(i, j) for i in range(n) for j in range(i)]
        ratios = [np.sqrt(diagonal[i] / (diagonal[j] * freedom)) for i, j in pairs]
        if ratios:
            lower = lower + np.stack(ratios) * normals[n * n + n : -1]
        diagonal = diagonal / (root * root * root)
    A = best.A
    if "A" not in given.names:
        white = normals[: n * n].reshape(n, n, -1) / np.sqrt(fitted.diagonal)
        A = A + backwards(applied_factors(Factors(lower, diagonal), white), fitted.information)
    if "mu_d" not in given.names:
        counts = moments.packets * mu_d * (1.0 - mu_d)
        logit = log(mu_d / (1.0 - mu_d)) + normals[-1] / np.sqrt(counts)
        mu_d = 1.0 / (1.0 + exp(-np.clip(logit, -30.0, 30.0)))
    return fitted.about(A - best.A), Parameters(A, lower, diagonal, mu_d)


_MOST = 4096
_RIDGE = 0.3  # weight of the imagined transition in which the state stays: more than for one climb, as there is a draw from it


class Cloud(NamedTuple):
    """N particles for each of R trials, side by side: column p R + r."""

    posterior: LearnerPosterior
    theta: Parameters
    moments: Moments
    weight: Floats
    """Logarithms, (N R,)."""

    def at(self, columns: NDArray[np.intp]) -> Cloud:
        """Some of the columns."""
        posterior, theta, moments = ([part[..., columns] for part in group] for group in self[:3])
        return Cloud(LearnerPosterior(*posterior), Parameters(*theta), Moments(*moments), self.weight[columns])

    def moved(self, chosen: Flags, theta: Parameters, moments: Moments) -> Cloud:
        """These with other parameters and moments where chosen, (N R,)."""
        return self._replace(
            theta=Parameters(*(np.where(chosen, *pair) for pair in zip(theta, self.theta, strict=True))),
            moments=Moments(*(np.where(chosen, *pair) for pair in zip(moments, self.moments, strict=True))),
        )


class LearningParticle(Learner):
    """Learns A, Q, μ_d and Σ_k from its own packets, by `particles` candidates; `knows`: what it is told.

    `Belief.memory`: the cloud's arrays with the particles as last axis but one, then the packets' scale and largest entries.
    """

    parameters = MappingProxyType({"knows": [], "particles": 64})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._count = int(knowledge.parameters["particles"])
        self._numbers = numbers_of(knowledge.process.n)
        self._coins = BlockReader(knowledge.keys["coin"], batch, self._count * self._numbers + 1)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003 - alike for all
        """Its own coin, for resampling and draws."""
        return ("coin",)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Names that are known, and a number of particles."""
        return knowing_mistakes(given) + whole_number_mistakes(given, "particles", 2, _MOST)

    def prior(self, first: int = 0) -> Belief:  # noqa: ARG002 - it knows nothing of earlier slots
        """x̂ = 0, and the covariance I for want of Σ0."""
        theta = Parameters(*(np.repeat(part, self.trials, axis=-1) for part in lattice(self.known, self._count)))
        ones = np.ones(self._count * self.trials)
        cloud = Cloud(unheard(self.known, ones), theta, self._imagined(theta, ones), np.zeros_like(ones))
        nothing = np.zeros((self.process.n, self.trials))
        return self._belief_of(cloud, np.zeros(self.trials, np.uint8), np.ones(self.trials), nothing)

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """Every particle has the state; their parameters stay."""
        cloud, scale, largest = self._read(belief)
        stored = self._stored(cloud._replace(posterior=cloud.posterior.knowing(self._wide(x))), scale, largest)
        return super().knowing(k, x, belief)._replace(memory=stored)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Weigh the packet by every particle, and the particles by the packet."""
        cloud, scale, largest = self._read(belief)
        gamma = heard.gamma
        z = np.where(gamma, heard.z, 0.0)
        first = gamma & (cloud.posterior.packets[: self.trials] == 0.0)
        if first.any():
            cloud, scale = self._scaled(cloud, scale, first, z)
        posterior, theta, moments, weight = cloud
        many, packet = self._wide(gamma), self._wide(z)
        after = advanced(k, self.known, theta, posterior, many, packet)
        if k and not self.known.everything:
            fraction = np.where(many, 1.0 - 1.0 / (k + 2.0), 1.0)
            moments = moments.faded(fraction).added(theta.A, packet, many.astype(np.float64), after.last)
        weight = weight + after.evidence
        most = self._narrow(weight).max(axis=0)
        weight = weight - self._wide(most)
        portion = self._portion(weight)
        state = summed(portion * self._narrow(after.state))
        cloud = self._renewed(k, Cloud(after.posterior, theta, moments, weight), portion, scale)
        action = read_actions(gamma, state > 0.5)
        return self._belief_of(cloud, action, scale, np.maximum(largest, np.abs(z)))

    def learned(self, belief: Belief) -> Mapping[str, Floats]:
        """The means over the particles."""
        cloud = self._read(belief)[0]
        portion, theta = self._portion(cloud.weight), cloud.theta
        each = {"A": theta.A, "Q": covariance(theta.noise), "mu_d": theta.mu_d}
        return {name: self._mean(portion, values) for name, values in each.items()}

    def _scaled(self, cloud: Cloud, scale: Floats, first: Flags, z: Floats) -> tuple[Cloud, Floats]:
        """The particles in units of the first packet, where this is the first (R,)."""
        scale = np.where(first, scale_of(first[None], z[None]), scale)
        theta, many = cloud.theta, self._wide(scale)
        if "Q" not in self.known.names:
            theta = theta._replace(diagonal=theta.diagonal * np.where(self._wide(first), many, 1.0))
        return cloud.moved(self._wide(first), theta, self._imagined(theta, many)), scale

    def _imagined(self, theta: Parameters, scale: Floats) -> Moments:
        moments = Moments.imagined(theta.A, scale, _RIDGE)
        return moments._replace(square=moments.square + covariance(theta.noise))

    def _renewed(self, k: int, cloud: Cloud, portion: Floats, scale: Floats) -> Cloud:
        """Resample and move in the trials where the particles are worth fewer than half their number."""
        few = 2.0 * summed(portion * portion) * self._count > 4.0
        if self.known.everything or not few.any():
            return cloud
        slot = range(k, k + 1)
        normals, offset = self._coins.normals(slot)[0, :-1], self._coins.uniforms(slot)[0, -1]
        up_to = np.cumsum(portion, axis=0)
        ancestors = np.empty((self._count, self.trials), np.intp)
        for i in range(self._count):
            ancestors[i] = np.minimum((up_to <= (i + offset) / self._count * up_to[-1]).sum(axis=0), self._count - 1)
        itself = np.arange(self._count)[:, None]
        columns = (np.where(few, ancestors, itself) * self.trials + np.arange(self.trials)).reshape(-1)
        cloud = cloud.at(columns)
        chosen = self._wide(few)
        numbers = normals.reshape(self._count, self._numbers, self.trials).swapaxes(0, 1).reshape(self._numbers, -1)
        moments, theta = drawn(cloud.moments, cloud.theta, self._wide(scale), self.known, numbers)
        return cloud.moved(chosen, theta, moments)._replace(weight=np.where(chosen, 0.0, cloud.weight))

    def _portion(self, weight: Floats) -> Floats:
        """Probabilities of the particles, (N, R), from logarithms, the largest of which is 0 in every trial."""
        likely = exp(np.maximum(self._narrow(weight), -700.0))
        return likely / summed(likely)

    def _mean(self, portion: Floats, values: Floats) -> Floats:
        """The mean over particles of values (…, N R), (…, R)."""
        total = np.zeros((*values.shape[:-1], self.trials))
        for p, fraction in enumerate(portion):
            total += fraction * values[..., p * self.trials : (p + 1) * self.trials]
        return total

    def _belief_of(self, cloud: Cloud, action: Codes, scale: Floats, largest: Floats) -> Belief:
        means, within = moments_of(cloud.posterior.mixture)
        portion = self._portion(cloud.weight)
        x_hat = self._mean(portion, means)
        away = means - self._wide(x_hat)
        P = self._mean(portion, within + away[:, None] * away[None])
        x_hat, P = self.in_proportion(x_hat, P, largest)
        return Belief(x_hat, P, action, self._stored(cloud, scale, largest))

    def _wide(self, values: NDArray[Any]) -> NDArray[Any]:
        """(…, R) for all particles, (…, N R)."""
        return np.concatenate([values] * self._count, axis=-1)

    def _narrow(self, values: Floats) -> Floats:
        """(N R,) as (N, R)."""
        return values.reshape(self._count, self.trials)

    def _stored(self, cloud: Cloud, scale: Floats, largest: Floats) -> tuple[NDArray[Any], ...]:
        posterior, theta, moments, weight = cloud
        columns = (*posterior, *theta, *moments, weight)
        return (*(part.reshape(*part.shape[:-1], self._count, self.trials) for part in columns), scale, largest)

    def _read(self, belief: Belief) -> tuple[Cloud, Floats, Floats]:
        *columns, scale, largest = belief.memory
        flat = [part.reshape(*part.shape[:-2], self._count * self.trials) for part in columns]
        return (
            Cloud(LearnerPosterior(*flat[:7]), Parameters(*flat[7:11]), Moments(*flat[11:18]), flat[18]),
            scale,
            largest,
        )
