"""Eavesdroppers that learn: they know the mechanism of the scheme, but neither the process nor μ_d.

A learner is told some things about the process, and assumes others. From slot to slot it has a posterior of the state and of the
last transition, where every trial has its own A, Q, Σ and μ_d, and Σ_k is estimated from the packets. Weighted moments of
transitions (x_{k−1}, x_k) say which A, Q and μ_d are most likely.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from evedrop.model.checks import as_toml
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.kernels.elementary import cholesky, exp, log
from evedrop.model.kernels.factored import (
    Entry,
    Factor,
    Factors,
    covariance,
    orthogonalised,
    parts_of_joint,
    squared_length,
    whitened,
)
from evedrop.model.kernels.mixtures import Mixture, opened, pruned, summed
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags
from evedrop.model.streams import Batch

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
    predicted, gain, spread = parts_of_joint(joint)
    informed = orthogonalised(_beside(carried, remaining.unit()), [*of.diagonal, *of_remaining])
    mean = np.clip(multiplied(theta.A, of.mean), -_LARGEST, _LARGEST)
    away, alone = z[:, None, :] - mean, squared_length(sigma, z)
    ratios = np.where(gamma, of.weight * _likely(away, predicted, alone, sigma), 0.0)
    ratio = summed(ratios)
    state = _state_probability(theta.mu_d, ratio, gamma)
    fraction = np.divide(ratios, ratio, out=np.zeros(ratios.shape), where=ratio > 0.0) * state
    before = of.mean + _entries(gain, whitened(predicted, away))
    mean = np.where(gamma, mean + _entries(told, whitened(sigma, z))[:, None, :], mean)
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
    new, told, remaining = parts_of_joint(orthogonalised(rows, [*sigma.diagonal, *theta.noise.diagonal]))
    return Factors(new.lower, np.minimum(new.diagonal, _LARGEST * _LARGEST)), told, remaining


def _likely(away: Floats, predicted: Factors, alone: Floats, sigma: Factors) -> Floats:
    """N(z; m_j, P_j) / N(z; 0, Σ_k), (C, R); away: z − m_j, (n, C, R); alone: zᵀ Σ_k⁻¹ z, (R,)."""
    exponent = alone - squared_length(predicted, away) + _log_determinant(sigma) - _log_determinant(predicted)
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
    product: list[list[Entry]] = [[A[i, j] for j in range(n)] for i in range(n)]  # U's diagonal is 1
    for i, row in enumerate(product):
        for j in range(n):
            for c in range(j + 1, n):
                row[j] = row[j] + A[i, c] * U[c][j]
    return product


def _beside(left: list[list[Entry]], right: list[list[Entry]]) -> list[list[Entry]]:
    """The rows of [left right]."""
    return [[*row, *other] for row, other in zip(left, right, strict=True)]


def _zero(n: int) -> list[list[Entry]]:
    """The matrix 0."""
    return [[0.0] * n for _ in range(n)]


def _over(values: Floats, weight: Floats) -> Floats:
    """(n, R) numbers of trials as those of their components, (n, C, R)."""
    return np.broadcast_to(values[:, None, :], (len(values), *weight.shape))


def _entries(M: list[list[Floats]], x: list[Floats]) -> Floats:
    """M x, from the entries of M and x, each of one shape."""
    totals = []
    for row in M:
        total = row[0] * x[0]
        for entry, value in zip(row[1:], x[1:], strict=True):
            total = total + entry * value
        totals.append(total)
    return np.stack(totals)


KNOWABLE = ("A", "Q", "mu_d", "initial_covariance")
"""What it may be given."""


@dataclass(frozen=True)
class Known:
    """What an eavesdropper knows about the process, and what it assumes about the rest."""

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


def known(process: Process, state_probability: float, knows: Iterable[str]) -> Known:
    """What an eavesdropper is told; state_probability: μ_d; knows: names among `KNOWABLE`."""
    names = frozenset(knows)
    identity = np.eye(process.n)

    def factors(name: str, M: Floats) -> Factors:
        return Factors.alike(Factor.of_triangular(cholesky(M if name in names else identity).tolist()), (1,))

    return Known(
        names,
        process.A if "A" in names else identity,
        factors("Q", process.Q),
        state_probability if "mu_d" in names else 0.5,
        factors("initial_covariance", process.initial_covariance),
    )


def knowing_mistakes(given: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A mistake in `knows`."""
    names = given.get("knows", [])
    if isinstance(names, (list, tuple)) and all(isinstance(name, str) and name in KNOWABLE for name in names):
        return []
    return [("knows", f"is {as_toml(names)}; expected a list of names among {as_toml(list(KNOWABLE))}, or []")]


CAPACITY = 6
"""The most components of a trial's posterior."""
_EARLY = 4  # packets whose mean square is the scale of all
# Times the largest packet: no state and no standard deviation is taken to be larger, because A may be wrong.
_FARTHEST = 4.0


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


def unheard(given: Known, scale: Floats) -> LearnerPosterior:
    """The posterior before the first packet; scale: a variance, (R,), for want of Σ0."""
    n, trials = len(given.A), len(scale)
    sigma = Factors(*(np.repeat(part, trials, axis=-1) for part in given.initial))
    if "initial_covariance" not in given.names:
        sigma = Factors(np.zeros_like(sigma.lower), np.repeat(scale[None], n, axis=0))
    mixture = Mixture(np.ones((1, trials)), np.zeros((n, 1, trials)), *(part[:, None, :].copy() for part in sigma))
    return LearnerPosterior(*mixture, *sigma, np.zeros(trials))


def advanced(k: int, given: Known, theta: Parameters, posterior: LearnerPosterior, gamma: Flags, z: Floats) -> Advanced:
    """The posterior after slot k; gamma (R,); z (n, R), 0 where nothing was received."""
    mixture, sigma, packets = posterior.mixture, posterior.sigma, posterior.packets
    evidence, last = np.zeros(len(gamma)), nothing(*z.shape)
    if k:
        mixture, sigma, evidence, state, last = weighed(theta, sigma, mixture, gamma, z, CAPACITY)
    else:
        mixture, state = begun(mixture, gamma, z, CAPACITY)
    if not given.sigma:
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


RIDGE = 1e-3
"""Weight of the imagined transition that makes the regression nonsingular."""
_LEAST_MOMENT = 1e-9  # least D in the factors of Q, over the variance of the first packets
_LARGEST_MOMENT = 1e6  # largest entry of A


class Moments(NamedTuple):
    """Sums over the transitions of R trials, each with its probability r as weight."""

    lower: Floats
    """Factors of Σ r E x_{k−1} x_{k−1}ᵀ, (n (n−1)/2, R)."""
    diagonal: Floats
    """(n, R)."""
    cross: Floats
    """Σ r E (x_k − A x_{k−1}) x_{k−1}ᵀ, (n, n, R)."""
    square: Floats
    """Σ r E (x_k − A x_{k−1})(x_k − A x_{k−1})ᵀ, (n, n, R)."""
    transitions: Floats
    """Σ r, (R,)."""
    states: Floats
    """Packets that were the state, (R,)."""
    packets: Floats
    """All packets, (R,)."""

    @classmethod
    def imagined(cls, A: Floats, scale: Floats, ridge: float = RIDGE) -> Moments:
        """Those of one transition of little weight, in which the state stays, and of one packet of each type.

        A (n, n, R); scale: the variance of the first packets, (R,); ridge: the transition's weight.
        """
        n, _, trials = A.shape
        weight, away = ridge * scale, np.eye(n)[:, :, None] - A
        return cls(
            np.zeros((n * (n - 1) // 2, trials)),
            np.repeat(weight[None], n, axis=0),
            weight * away,
            weight * outer(away, away),
            np.zeros(trials),
            np.ones(trials),
            np.full(trials, 2.0),
        )

    @property
    def information(self) -> Factors:
        """The factors of Σ r E x_{k−1} x_{k−1}ᵀ."""
        return Factors(self.lower, self.diagonal)

    def faded(self, fraction: Floats) -> Moments:
        """The same with `fraction` (R,) of every weight."""
        return Moments(self.lower, *(part * fraction for part in self[1:]))

    def added(self, A: Floats, z: Floats, heard: Floats, last: Transition) -> Moments:
        """These and the transition to a slot whose packets are z (n, R), 0 where none was heard (R,); A (n, n, R)."""
        rows, weights = [list(row) for row in self.information.unit()], list(self.diagonal)
        cross, square = self.cross, self.square
        for c in np.flatnonzero(last.fraction.any(axis=1)):
            fraction, before = last.fraction[c], last.before[:, c]
            spread = Factors(last.spread.lower[:, c], last.spread.diagonal[:, c])
            away, carried = z - applied(A, before), multiplied(A, covariance(spread))
            cross = cross + fraction * (away[:, None] * before[None] - carried)
            square = square + fraction * (away[:, None] * away[None] + outer(carried, A))
            for row, value, unit in zip(rows, before, spread.unit(), strict=True):
                row += [value, *unit]
            weights += [fraction, *(fraction * D for D in spread.diagonal)]
        state = summed(last.fraction)
        return Moments(
            *orthogonalised(rows, weights),
            cross,
            square,
            self.transitions + state,
            self.states + state,
            self.packets + heard,
        )

    def about(self, step: Floats) -> Moments:
        """The same about A + step, (n, n, R)."""
        carried = multiplied(step, covariance(self.information))
        square = self.square - outer(self.cross, step) - outer(step, self.cross) + outer(carried, step)
        return self._replace(cross=self.cross - carried, square=square)

    def most_likely(self, theta: Parameters, scale: Floats, knows: frozenset[str]) -> tuple[Moments, Parameters]:
        """The parameters that make these moments most likely, and the moments about the new A.

        theta: the parameters so far, which stay where they are known; scale: the variance of the first packets, (R,).
        """
        A = theta.A
        if "A" not in knows:
            A = np.clip(A + divided(self.cross, self.information), -_LARGEST_MOMENT, _LARGEST_MOMENT)
        moments = self.about(A - theta.A)
        noise = theta.noise
        if "Q" not in knows:
            noise = factored(moments.square / (self.transitions + 1.0), _LEAST_MOMENT * scale)
        return moments, Parameters(A, *noise, theta.mu_d if "mu_d" in knows else self.states / self.packets)


def factored(M: Floats, least: Floats) -> Factors:
    """Factors of symmetric matrices (n, n, R), with D not below `least` (R,): they may be semidefinite but for rounding."""
    n, _, trials = M.shape
    U, D = np.zeros_like(M), np.empty((n, trials))
    for j in range(n):
        for i in range(j, n):
            rest = M[i, j]
            for c in range(j):
                rest = rest - U[i, c] * U[j, c] * D[c]
            if i == j:
                D[j] = np.maximum(rest, least)
            U[i, j] = rest / D[j]
    lower = [U[i, j] for i in range(n) for j in range(i)]
    return Factors(np.array(lower).reshape(len(lower), trials), D)


def divided(M: Floats, P: Factors) -> Floats:
    """M P⁻¹ of every trial, (n, n, R): row by row, by substitution forwards and backwards."""
    return backwards(np.array([np.stack(whitened(P, row)) / P.diagonal for row in M]), P)


def backwards(M: Floats, P: Factors) -> Floats:
    """M U⁻¹ of every trial, (n, n, R), U of the factors P."""
    n, U = len(M), P.unit()
    solution = np.empty_like(M)
    for r, row in enumerate(M):
        for i in reversed(range(n)):
            rest = row[i]
            for j in range(i + 1, n):
                rest = rest - U[j][i] * solution[r, j]
            solution[r, i] = rest
    return solution


def applied_factors(P: Factors, M: Floats) -> Floats:
    """U D^½ M of every trial, (n, n, R), from the factors P."""
    U, scaled = P.unit(), np.sqrt(P.diagonal)[:, None] * M
    applied = scaled.copy()
    for i in range(len(M)):
        for j in range(i):
            applied[i] = applied[i] + U[i][j] * scaled[j]
    return applied


def multiplied(M: Floats, N: Floats) -> Floats:
    """M N of every trial, (n, m, R), from M (n, n, R) and N (n, m, R)."""
    result: Floats = M[:, 0, None] * N[0]
    for j in range(1, len(N)):
        result = result + M[:, j, None] * N[j]
    return result


def outer(M: Floats, N: Floats) -> Floats:
    """M Nᵀ of every trial, (n, n, R)."""
    return multiplied(M, N.swapaxes(0, 1))


def applied(M: Floats, x: Floats) -> Floats:
    """M x of every trial, (n, R)."""
    product: Floats = M[:, 0] * x[0]
    for j in range(1, len(x)):
        product = product + M[:, j] * x[j]
    return product


class Learner(PacketReader):
    """Learns A, Q, μ_d and Σ_k from its own packets; its parameter `knows` names those that it is told."""

    only_against = (
        ("innovation", "plain"),
        "learns from packets each of which is the state or an innovation, and others would mislead it",
    )
    inverts_noise = True  # if it knows Q
    costly = True

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self.known = known(knowledge.process, knowledge.state_probability, knowledge.parameters["knows"])

    def in_proportion(self, x_hat: Floats, P: Floats, largest: Floats) -> tuple[Floats, Floats]:
        """Mean and covariance, smaller where an estimate of A has put them out of all proportion to the largest packets."""
        return (x_hat, P) if "A" in self.known.names else bounded(x_hat, P, largest)
