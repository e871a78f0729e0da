"""Mixtures of normal distributions, one for every trial of a batch: pruning, merging and sums that no batch size changes.

With them a slot of the Bayesian eavesdropper in numpy: the components of its posterior, weighed by a packet, and what an
innovation packet tells about w_{k−1}; `evedrop.model.theory.leak` says where the numbers come from.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.elementary import Floats, exp, product
from evedrop.model.kernels.factored import Factor, Factors, covariance, grown, orthogonalised, solved, squared_length

NEGLIGIBLE = 1e-12
"""The largest probability of a component that is dropped."""


class Mixture(NamedTuple):
    """Up to C components for every trial; a weight of 0 marks an empty place. A component keeps its place."""

    weight: Floats
    """(C, R); sums to 1 in every trial."""
    mean: Floats
    """(n, C, R)."""
    lower: Floats
    """The covariances' factors, (n (n−1)/2, C, R)."""
    diagonal: Floats
    """(n, C, R)."""

    @property
    def spread(self) -> Factors:
        """The covariances."""
        return Factors(self.lower, self.diagonal)


def summed(values: Floats) -> Floats:
    """Sum over components, (C, R) → (R,), one after the other, so that empty places change no bit."""
    total = np.zeros(values.shape[1:])
    for row in values:
        total += row
    return total


def pruned(of: Mixture) -> Mixture:
    """The mixture without negligible components, and without places that no trial needs."""
    weight = np.where(of.weight > NEGLIGIBLE, of.weight, 0.0)
    count = _places(weight)
    return Mixture(weight[:count], *(part[:, :count] for part in of[1:]))


def _places(weight: Floats) -> int:
    """The number of places up to the last that any trial uses."""
    used = np.flatnonzero(weight.any(axis=1))
    return int(used[-1]) + 1 if used.size else 0


def with_a_place(part: Floats, axis: int) -> Floats:
    """A part of a mixture with one more component, which is empty."""
    shape = list(part.shape)
    shape[axis] = 1
    return np.concatenate([part, np.zeros(shape)], axis=axis)


def merge(of: Mixture, trials: NDArray[np.intp]) -> None:
    """Merge the two least probable components of some trials, in place; the second place is then empty."""
    weight = of.weight[:, trials]
    weight = np.where(weight > 0.0, weight, np.inf)
    columns = np.arange(len(trials))
    first = np.argmin(weight, axis=0)
    without = weight.copy()
    without[first, columns] = np.inf
    second = np.argmin(without, axis=0)
    kept, gone = ((place, trials) for place in (first, second))
    total = of.weight[kept] + of.weight[gone]
    a, b = of.weight[kept] / total, of.weight[gone] / total
    apart = [m[gone] - m[kept] for m in of.mean]
    U, V = ([[*row] for row in Factors(of.lower[:, p, t], of.diagonal[:, p, t]).unit()] for p, t in (kept, gone))
    weights = [*(a * of.diagonal[(slice(None), *kept)]), *(b * of.diagonal[(slice(None), *gone)]), a * b]
    lower, diagonal = orthogonalised([u + v + [d] for u, v, d in zip(U, V, apart, strict=True)], weights)
    for m, d in zip(of.mean, apart, strict=True):
        m[kept] += b * d
    of.lower[(slice(None), *kept)], of.diagonal[(slice(None), *kept)] = lower, diagonal
    of.weight[kept], of.weight[gone] = total, 0.0


def opened(of: Mixture, state: Floats, z: Floats, capacity: int) -> Mixture:
    """The mixture with a new component for each packet z (n, R), in the trial's first empty place, weighted by `state` (R,).

    Takes ownership of the arrays of `of`, which must not be used afterwards. Empty places have 0 everywhere.
    """
    new = np.flatnonzero(state > NEGLIGIBLE)
    free = of.weight[:, new] == 0.0
    full = new[~free.any(axis=0)]
    if full.size:
        if len(of.weight) < capacity:
            of = Mixture(*(with_a_place(part, part.ndim - 2) for part in of))
        else:
            merge(of, full)
        free = of.weight[:, new] == 0.0
    if new.size:
        place = np.argmax(free, axis=0)
        of.weight[place, new] = state[new]
        of.mean[:, place, new] = z[:, new]
        of.lower[:, place, new] = 0.0
        of.diagonal[:, place, new] = 0.0
    weight, there = np.zeros(of.weight.shape), of.weight != 0.0
    np.divide(of.weight, summed(of.weight), out=weight, where=there)
    weight = weight[: _places(weight)]
    return Mixture(weight, *(np.where(weight != 0.0, part[:, : len(weight)], 0.0) for part in of[1:]))


def moments(of: Mixture) -> tuple[Floats, Floats]:
    """Mean and covariance of every trial's mixture, (n, R) and (n, n, R)."""
    n, there = len(of.mean), of.weight != 0.0
    x_hat = np.stack([summed(of.weight * row) for row in of.mean])
    away, within = of.mean - x_hat[:, None, :], covariance(of.spread)
    P = np.empty((n, n, x_hat.shape[1]))
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = P[j, i] = summed(np.where(there, of.weight * (within[i, j] + away[i] * away[j]), 0.0))
    return x_hat, P


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


_Flags = NDArray[np.bool_]
_Kind = TypeVar("_Kind", bound=np.generic)

_CERTAIN = 300.0  # an exponent at which a packet is certainly the state, still far from overflow
_SURE = 1e300  # stands for all larger odds
_IMPOSSIBLE = -700.0  # an exponent at which it certainly is not, still far from underflow


class MixtureModel(NamedTuple):
    """What does not change from slot to slot."""

    A: Floats
    """(n, n)."""
    noise: Factor
    """Q, factored."""
    state_probability: float
    """μ_d."""
    capacity: int
    """The most components of a trial."""


def step(
    model: MixtureModel, of: Mixture, gamma: _Flags, z: Floats, leak: Leak | None, rounding: Floats
) -> tuple[Mixture, Floats]:
    """The mixture one slot later, and the probability that the packet is the state, (R,).

    gamma (R,); z (n, R), 0 where nothing was received; leak: None in slot 0, in which a packet is the state; rounding (n,): the
    least variance of packets about their prediction.
    """
    if leak is None:
        state = gamma.astype(np.float64)
        of = Mixture(np.where(gamma, 0.0, of.weight), *(part.copy() for part in of[1:]))
    else:
        of, state = _weighed(model, of, gamma, z, leak, rounding)
    return opened(pruned(of), state, z, model.capacity), state


def _weighed(
    model: MixtureModel, of: Mixture, gamma: _Flags, z: Floats, leak: Leak, rounding: Floats
) -> tuple[Mixture, Floats]:
    """The components one slot later, without the packet's own, and the probability that the packet is the state, (R,).

    The costly steps skip empty places, which usually are half of all.
    """
    there = np.flatnonzero(of.weight)
    trial = there % max(1, of.weight.shape[1])
    some = Mixture(*(_taken(part.reshape(*part.shape[:-2], of.weight.size), there) for part in of))
    white, heard = leak.white(z), _taken(gamma, trial)
    mean = product(model.A, some.mean)
    predicted, informed = grown(model.A, some.spread, model.noise, leak.remaining_factor)
    seen = predicted.rounded(rounding)
    squared = squared_length(seen, _taken(z, trial) - mean)
    alone = _taken(_squared(white), trial)
    ratios = np.zeros(of.weight.shape)
    ratios.reshape(-1)[there] = _weighed_ratios(
        heard, some.weight, squared, np.where(predicted.diagonal > 0.0, seen.diagonal, predicted.diagonal), alone, leak
    )
    state, other = _type_probabilities(model.state_probability, summed(ratios), gamma)
    mean += _taken(np.where(gamma, leak.innovation(white), 0.0), trial)
    for after, after_informed in zip(predicted, informed, strict=True):
        np.copyto(after, after_informed, where=heard)
    spread = [np.zeros(part.shape) for part in of[1:]]
    for whole, part in zip(spread, (mean, *predicted), strict=True):
        for row, values in zip(whole.reshape(len(whole), of.weight.size), part, strict=True):
            row[there] = values
    return Mixture(of.weight * other, *spread), state


def _type_probabilities(mu_d: float, ratio: Floats, gamma: _Flags) -> tuple[Floats, Floats]:
    """Probabilities that the packet is the state, and that it is not, (R,); 0 and 1 where nothing was received.

    ratio: of the packet's densities under the two types, (R,).
    """
    if mu_d == 1.0:
        state = gamma.astype(np.float64)
        return state, 1.0 - state
    odds = np.minimum(mu_d / (1.0 - mu_d) * ratio, _SURE)
    return np.where(gamma, odds / (1.0 + odds), 0.0), np.where(gamma, 1.0 / (1.0 + odds), 1.0)


def _taken(part: NDArray[_Kind], places: NDArray[np.intp]) -> NDArray[_Kind]:
    """Some places of the last axis, all of them valid."""
    return part.take(places, axis=-1, mode="clip") if len(places) else part[..., :0]


def _squared(white: Floats) -> Floats:
    """Squared lengths of (n, R), (R,)."""
    total: Floats = white[0] * white[0]
    for row in white[1:]:
        total += row * row
    return total


def _weighed_ratios(
    heard: _Flags, weight: Floats, squared: Floats, diagonal: Floats, alone: Floats, leak: Leak
) -> Floats:
    """π_j N(z; m_j, P_j) / N(z; 0, Σ_k) of components whose trial received z, (N,); 0 for all others.

    weight: π, (N,); squared: (z − m)ᵀ P⁻¹ (z − m), (N,); diagonal: D of P's factors, (n, N); alone: zᵀ Σ_k⁻¹ z, (N,). A packet in
    the range of a singular P has an infinite density, for which 1e300 stands.
    """
    exponent = 0.5 * (alone - squared)
    # Most packets are far from the threshold, and need no exponential.
    some = np.flatnonzero((exponent > _IMPOSSIBLE) & heard)
    determinant = np.ones(len(some))
    for D, state in zip(diagonal, leak.state_diagonal, strict=True):
        determinant *= D[some] / state
    likely = exp(np.minimum(exponent[some], _CERTAIN))
    ratios = np.zeros(weight.shape)
    with np.errstate(divide="ignore", over="ignore"):
        likelihoods = weight[some] * likely / np.sqrt(determinant)
    ratios[some] = np.where(likelihoods > _SURE, _SURE, likelihoods)
    return ratios
