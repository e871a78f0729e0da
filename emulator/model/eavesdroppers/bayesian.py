"""The Bayesian eavesdropper: knows the mechanism but not the secret, and weighs every possible history.

Its posterior is a mixture with a component for each slot j that may have brought the last state packet it received: x_j was
that packet, and all later packets were innovations. A packet either starts a new component, or is one more innovation
for all others.

Source: docs/mathematics.md, bayesian eavesdropper.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from evedrop.kernels.elementary import cholesky, exp
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.numeric.factored import Factor, Factors, covariance, grown, squared_length
from evedrop.model.numeric.mixture import NEGLIGIBLE, Mixture, merge, pruned, summed, with_a_place
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Flags, Reception
from evedrop.model.theory.leak import Leak, Leaks
from evedrop.streams import Batch

_Kind = TypeVar("_Kind", bound=np.generic)

CAPACITY = 12
"""The most components of a trial; beyond it the two least probable ones are merged, with the same mean and covariance."""
_CERTAIN = 300.0  # an exponent at which a packet is certainly the state, still far from overflow
_SURE = 1e300  # stands for all larger odds
_IMPOSSIBLE = -700.0  # an exponent at which it certainly is not, still far from underflow


class Bayesian(PacketReader):
    """Minimum mean square error, apart from the loss where too many components would have to be kept.

    `Belief.memory` is its `Mixture`.
    """

    only_against = ("innovation", "weighs states against innovations, and there are none: it is the same as naive here")
    inverts_noise = True

    def __init__(self, knowledge: Knowledge, batch: Batch, capacity: int = CAPACITY) -> None:
        super().__init__(knowledge, batch)
        self._mu_d = knowledge.state_probability
        self._capacity = capacity
        self._leaks = Leaks(knowledge.process)
        self._trial_of = np.tile(np.arange(batch.trials), capacity)
        self._noise = Factor.of_triangular(cholesky(knowledge.process.Q).tolist())

    def prior(self, first: int = 0) -> Belief:
        """One component, without any reception."""
        belief = super().prior(first)
        n, trials = belief.x_hat.shape
        spread = Factors.alike(Factor.of_triangular(cholesky(belief.P[:, :, 0]).tolist()), (1, trials))
        return belief._replace(memory=Mixture(np.ones((1, trials)), np.zeros((n, 1, trials)), *spread))

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """One component with covariance 0."""
        belief, (n, trials) = super().knowing(k, x, belief), x.shape
        nothing = np.zeros((n * (n - 1) // 2, 1, trials)), np.zeros((n, 1, trials))
        return belief._replace(memory=Mixture(np.ones((1, trials)), x[:, None, :], *nothing))

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Predict every component, weight it by the packet and add the packet's own; returns their common mean and covariance."""
        gamma, z = heard.gamma, np.where(heard.gamma, heard.z, 0.0)
        mixture = Mixture(*belief.memory)
        if k == 0:
            state = gamma.astype(np.float64)
            mixture = Mixture(np.where(gamma, 0.0, mixture.weight), *(part.copy() for part in mixture[1:]))
        else:
            leak = self._leaks.at(k)
            mixture, state = self._weighed(mixture, gamma, z, leak)
        mixture = opened(pruned(mixture), state, z, self._capacity)
        x_hat, P = moments(mixture)
        action = np.where(
            gamma, np.where(state > 0.5, np.uint8(Action.STATE), np.uint8(Action.INNOVATION)), np.uint8(0)
        )
        return Belief(x_hat, P, action, mixture)

    def _weighed(self, of: Mixture, gamma: Flags, z: Floats, leak: Leak) -> tuple[Mixture, Floats]:
        """The components one slot later, and the probability that the packet is the state, (R,).

        The costly steps skip empty places, which usually are half of all.
        """
        there = np.flatnonzero(of.weight)
        trial = self._trial_of[there]
        some = Mixture(*(_taken(part.reshape(*part.shape[:-2], of.weight.size), there) for part in of))
        white, heard = leak.white(z), _taken(gamma, trial)
        mean = self.process.predict(some.mean)
        predicted, informed = grown(self.process.A, some.spread, self._noise, leak.remaining_factor)
        apart = _taken(z, trial) - mean
        squared = squared_length(predicted, list(apart))
        ratios = np.zeros(of.weight.shape)
        alone = _taken(_squared(white), trial)
        ratios.reshape(-1)[there] = _weighed_ratios(heard, some.weight, squared, predicted.diagonal, alone, leak)
        state, other = self._type_probabilities(summed(ratios), gamma)
        mean += _taken(np.where(gamma, leak.innovation(white), 0.0), trial)
        for after, known in zip(predicted, informed, strict=True):
            np.copyto(after, known, where=heard)
        spread = [np.zeros(part.shape) for part in of[1:]]
        for whole, part in zip(spread, (mean, *predicted), strict=True):
            for row, values in zip(whole.reshape(len(whole), of.weight.size), part, strict=True):
                row[there] = values
        return Mixture(of.weight * other, *spread), state

    def _type_probabilities(self, ratio: Floats, gamma: Flags) -> tuple[Floats, Floats]:
        """Probabilities that the packet is the state, and that it is not, (R,); 0 and 1 where nothing was received.

        ratio: of the packet's densities under the two types, (R,).
        """
        if self._mu_d == 1.0:
            state = gamma.astype(np.float64)
            return state, 1.0 - state
        odds = np.minimum(self._mu_d / (1.0 - self._mu_d) * ratio, _SURE)
        return np.where(gamma, odds / (1.0 + odds), 0.0), np.where(gamma, 1.0 / (1.0 + odds), 1.0)


def _taken(part: NDArray[_Kind], places: NDArray[np.intp]) -> NDArray[_Kind]:
    """Some places of the last axis, all of them valid."""
    return part.take(places, axis=-1, mode="clip")


def _squared(white: Floats) -> Floats:
    """Squared lengths of (n, R), (R,)."""
    total: Floats = white[0] * white[0]
    for row in white[1:]:
        total += row * row
    return total


def _weighed_ratios(
    heard: Flags, weight: Floats, squared: Floats, diagonal: Floats, alone: Floats, leak: Leak
) -> Floats:
    """π_j N(z; m_j, P_j) / N(z; 0, Σ_k) of components whose trial received z, (N,); 0 for all others.

    weight: π, (N,); squared: (z − m)ᵀ P⁻¹ (z − m), (N,); diagonal: D of P's factors, (n, N); alone: zᵀ Σ_k⁻¹ z, (N,).
    """
    exponent = 0.5 * (alone - squared)
    # Most packets are far from the threshold, and need no exponential.
    some = np.flatnonzero((exponent > _IMPOSSIBLE) & heard)
    determinant = np.ones(len(some))
    for D, state in zip(diagonal, leak.state_diagonal, strict=True):
        determinant *= D[some] / state
    likely = exp(np.minimum(exponent[some], _CERTAIN))
    ratios = np.zeros(weight.shape)
    ratios[some] = weight[some] * likely / np.sqrt(determinant)
    return ratios


def opened(of: Mixture, state: Floats, z: Floats, capacity: int) -> Mixture:
    """The mixture with a new component for each packet z (n, R), in the trial's first empty place, weighted by `state` (R,).

    Takes ownership of the arrays of `of`, which must not be used afterwards.
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
    return of._replace(weight=of.weight / summed(of.weight))


def moments(of: Mixture) -> tuple[Floats, Floats]:
    """Mean and covariance of every trial's mixture, (n, R) and (n, n, R)."""
    n = len(of.mean)
    x_hat = np.stack([summed(of.weight * row) for row in of.mean])
    away, within = of.mean - x_hat[:, None, :], covariance(of.spread)
    P = np.empty((n, n, x_hat.shape[1]))
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = P[j, i] = summed(of.weight * (within[i, j] + away[i] * away[j]))
    return x_hat, P
