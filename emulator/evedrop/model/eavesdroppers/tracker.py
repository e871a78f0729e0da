"""The tracker: follows both tracks of `twin-track`, and estimates their mean while it cannot know which is real.

The distribution of their distance says what one track reveals about the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky, exp, log
from evedrop.model.kernels.factored import (
    Factor,
    Factors,
    covariance,
    grown,
    orthogonalised,
    parts_of_joint,
    solved,
    squared_length,
    whitened,
)
from evedrop.model.kernels.mixtures import Mixture, merge, pruned, summed, with_a_place
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Belief, Flags, Reception, read_actions
from evedrop.model.streams import Batch, Recurrence


@final
class Apart:
    """The distance to the twin, given one track of a slot; its numbers depend only on the process."""

    def __init__(self, start: Floats, noise: Floats) -> None:
        n = len(start)
        nothing = np.zeros((n, n))
        joint = kernels.triangular_factors(np.block([[start, noise, nothing], [-start, nothing, start]])[None])[0]
        self._state = joint[:n, :n].tolist()
        self._gain = joint[n:, :n]
        self.factor = Factor.of_triangular(joint[n:, n:].tolist())
        """R_k, factored."""

    def mean(self, a: Floats) -> Floats:
        """G L_k⁻¹ a, (n, R), of tracks a (n, R)."""
        return product(self._gain, solved(self._state, a))


@final
class Twins:
    """`Apart` of any slot; asking for slots in order is quick."""

    def __init__(self, process: Process) -> None:
        A, noise = process.A, process.noise_factor

        def following(factors: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
            start, late = factors
            joint = np.concatenate([product(A, late), noise], axis=1)
            return product(A, start), kernels.triangular_factors(joint[None])[0]

        self._factors = Recurrence((cholesky(process.initial_covariance), np.zeros(A.shape)), following)

    def at(self, k: int) -> Apart:
        """The distance in slot k."""
        return Apart(*self._factors.at(k))


CAPACITY = 8
"""The most histories of either kind in a trial; beyond it the two least probable ones are merged."""


class FollowedTracks(NamedTuple):
    """Its knowledge of R trials' tracks. Of 2R columns the first R have the last track as x, the others its twin."""

    weight: Floats
    """The weight of each history, (C, 2R); they sum to 1 in each trial, or are 0 before its first packet."""
    mean: Floats
    """The mean of o, other − last track, (n, C, 2R)."""
    lower: Floats
    """The factors of its covariances, (n (n−1)/2, C, 2R)."""
    diagonal: Floats
    """(n, C, 2R)."""
    last: Floats
    """The last packet, predicted to this slot, (n, R); before the first packet 0, the mean of x."""
    noise_lower: Floats
    """Factors of the noise since the last packet, (n (n−1)/2, R); before the first packet, of the covariance of x."""
    noise_diagonal: Floats
    """(n, R)."""

    @property
    def histories(self) -> Mixture:
        """The part that packets distinguish."""
        return Mixture(*self[:4])

    @property
    def noise(self) -> Factors:
        """The part that is common to all histories."""
        return Factors(self.noise_lower, self.noise_diagonal)


class Tracker(PacketReader):
    """Minimum mean square error, apart from the loss where too many histories would have to be kept; needs no knowledge.

    Intended only for the scheme `twin-track`. Once a true state is betrayed to it, it knows which track is real, and follows it
    while the two are further apart than the noise between packets. `Belief.memory`: its `FollowedTracks`, 2R columns as (2, R).
    """

    only_against = ("twin-track", "takes the mean of two tracks, and there is only one")
    inverts_noise = True

    def __init__(self, knowledge: Knowledge, batch: Batch, capacity: int = CAPACITY) -> None:
        super().__init__(knowledge, batch)
        self._capacity = capacity
        self._noise = Factor.of_triangular(cholesky(knowledge.process.Q).tolist())
        self._any_noise = Factors.alike(self._noise, (self.trials,))
        self._initial = Factor.of_triangular(cholesky(knowledge.process.initial_covariance).tolist())
        self._twins = Twins(knowledge.process)

    def prior(self, first: int = 0) -> Belief:
        """The belief without any reception."""
        belief, n = super().prior(first), self.process.n
        sigma = Factors.alike(self._initial, (self.trials,))
        for _ in range(first - 1):
            (sigma,) = grown(self.process.A, sigma, self._noise)
        none = Mixture(*(np.zeros((*rows, 0, 2 * self.trials)) for rows in ((), (n,), (n * (n - 1) // 2,), (n,))))
        return belief._replace(memory=_stored(FollowedTracks(*none, belief.x_hat, *sigma)))

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Predict both tracks, and weigh which of them the packet is on; belief: mean and covariance over all histories."""
        tracks = _read(belief.memory)
        if k:
            tracks = self._carried(tracks)
        if heard.gamma.any():
            tracks = self._heard(k, tracks, heard.gamma, heard.z)
        total = summed(tracks.weight)
        # Until a state is betrayed, every history exists twice, bit for bit, with the last track as x and as its twin.
        told_apart = total[: self.trials] != total[self.trials :]
        action = read_actions(heard.gamma, told_apart)
        return Belief(*_moments(tracks, total), action, _stored(tracks))

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """Treat x as a packet that is known to be on the real track."""
        tracks, R = _read(belief.memory), self.trials
        # With a packet of this very slot there is nothing to weigh: either it is x, or it shows where the twin is.
        exact: Flags = ~np.any(tracks.noise_diagonal > 0.0, axis=0)
        distance = np.where(exact, tracks.last - x, 0.0)
        tracks = self._heard(k, tracks, ~exact, x)
        histories = self._afresh(tracks.histories, (distance != 0.0).any(axis=0), distance, _nothing(self.process.n))
        histories.weight[:, R:] = 0.0
        after = self._few(histories, np.ones(R, np.bool_))
        return super().knowing(k, x, belief)._replace(memory=_stored(FollowedTracks(*after, x, *tracks.noise)))

    def _carried(self, of: FollowedTracks) -> FollowedTracks:
        """The tracks one slot later."""
        A = self.process.A
        mean = self.process.predict(of.mean.reshape(len(A), -1)).reshape(of.mean.shape)
        (spread,) = grown(A, of.histories.spread, _nothing(len(A)))
        (noise,) = grown(A, of.noise, self._noise)
        return FollowedTracks(of.weight, mean, *spread, self.process.predict(of.last), *noise)

    def _heard(self, k: int, of: FollowedTracks, gamma: Flags, z: Floats) -> FollowedTracks:
        """The tracks with z (n, R) on one of them where gamma (R,): that one becomes the last track."""
        z = np.where(gamma, z, of.last)
        heard_of: Flags = np.any(of.weight > 0.0, axis=0)
        begun = gamma & ~(heard_of[: self.trials] | heard_of[self.trials :])
        # Where nothing was received the noise may be 0, and is not needed.
        noise = Factors(*(np.where(gamma, *pair) for pair in zip(of.noise, self._any_noise, strict=True)))
        histories = _split(of.histories, gamma, z - of.last, noise) if len(of.weight) else of.histories
        if begun.any():
            apart = self._twins.at(k)
            histories = self._afresh(histories, begun, apart.mean(np.where(begun, z, 0.0)), apart.factor)
        return FollowedTracks(*self._few(histories, gamma), z, *(np.where(gamma, 0.0, part) for part in of.noise))

    def _afresh(self, of: Mixture, where: Flags, mean: Floats, spread: Factor) -> Mixture:
        """One history of either kind in some trials (R,): o has this mean (n, R) and covariance."""
        if not len(of.weight):
            of = Mixture(*(with_a_place(part, part.ndim - 2) for part in of))
        first = np.arange(len(of.weight))[:, None] == 0
        fresh = Mixture(
            np.where(first, 0.5, np.zeros((1, 2 * self.trials))),
            _twice(mean)[:, None, :],
            *Factors.alike(spread, (1, 2 * self.trials)),
        )
        return Mixture(*(np.where(_twice(where), *pair) for pair in zip(fresh, of, strict=True)))

    def _few(self, of: Mixture, changed: Flags) -> Mixture:
        """Weights that sum to 1 where they changed (R,), at most as many histories as there is capacity for, and no gaps."""
        total = summed(of.weight)
        total = _twice(np.where(changed, total[: self.trials] + total[self.trials :], 1.0))
        of = pruned(of._replace(weight=of.weight / total))
        while (full := np.flatnonzero((of.weight > 0.0).sum(axis=0) > self._capacity)).size:
            merge(of, full)
        order = np.argsort(of.weight == 0.0, axis=0, kind="stable")
        count = int((of.weight > 0.0).sum(axis=0).max(initial=0))
        orders = (np.broadcast_to(order, part.shape) for part in of)
        return Mixture(*(np.take_along_axis(*both, axis=-2)[..., :count, :] for both in zip(of, orders, strict=True)))


def _split(of: Mixture, gamma: Flags, distance: Floats, noise: Factors) -> Mixture:
    """Duplicate every history where gamma (R,): the new place is on the last track, or on the other, which becomes the last.

    distance: from the last track to the new place, (n, R); noise: covariance of the last track, positive definite.
    """
    n, R = distance.shape
    gamma, distance, noise = _twice(gamma), _twice(distance), Factors(*(_twice(part) for part in noise))
    # The distribution of o given the new place, by one triangularisation of (o + noise, o), as for the leak.
    U, V = of.spread.unit(), noise.unit()
    rows = [[*u, *v] for u, v in zip(U, V, strict=True)] + [[*u, *[0.0] * n] for u in U]
    joint = orthogonalised(rows, [*of.diagonal, *noise.diagonal])
    seen, gain, rest = parts_of_joint(joint)
    white = whitened(seen, distance[:, None] - of.mean)
    evidence = squared_length(noise, distance) + np.zeros_like(of.weight)
    for away, D, own in zip(white, seen.diagonal, noise.diagonal, strict=True):
        evidence = evidence - away * away / D - log(D / own)
    evidence = np.where(gamma & (of.weight > 0.0), 0.5 * evidence, 0.0)
    most = evidence.max(axis=0)
    most = _twice(np.maximum(np.maximum(most[:R], most[R:]), 0.0))
    mean = np.empty_like(of.mean)
    for i, row in enumerate(gain):
        moved = of.mean[i]
        for factor, away in zip(row, white, strict=True):
            moved = moved + factor * away
        mean[i] = -moved
    other = Mixture(np.where(gamma, of.weight * exp(evidence - most), 0.0), mean, *rest)
    same = of._replace(weight=of.weight * exp(-most))
    # The history of the last track is now that of the other one.
    return Mixture(*(np.concatenate([a, np.roll(b, R, axis=-1)], axis=-2) for a, b in zip(same, other, strict=True)))


def _moments(of: FollowedTracks, total: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of x in every trial, (n, R) and (n, n, R); total: sum of the weights, (2R,)."""
    n, R = of.last.shape
    weight, mean, lower, diagonal = (part[..., R:] for part in of.histories)
    middle = np.array([summed(weight * row) for row in mean])
    away, within, P = mean - middle[:, None, :], covariance(Factors(lower, diagonal)), covariance(of.noise)
    for i in range(n):
        for j in range(i + 1):
            spread = summed(weight * (within[i, j] + away[i] * away[j])) + total[:R] * (middle[i] * middle[j])
            P[i, j] = P[j, i] = P[i, j] + spread
    return of.last + middle, P


def _nothing(n: int) -> Factor:
    """The covariance 0."""
    return Factor([[1.0 if j == i else 0.0 for j in range(n)] for i in range(n)], [0.0] * n)


def _twice(part: NDArray[Any]) -> NDArray[Any]:
    """(…, R) → (…, 2R)."""
    return np.concatenate([part, part], axis=-1)


def _stored(tracks: FollowedTracks) -> tuple[Floats, ...]:
    """The arrays with the trials as last axis."""
    return (*(part.reshape(*part.shape[:-1], 2, part.shape[-1] // 2) for part in tracks.histories), *tracks[4:])


def _read(memory: tuple[NDArray[Any], ...]) -> FollowedTracks:
    """The tracks of a memory, with 2R columns."""
    return FollowedTracks(*(part.reshape(*part.shape[:-2], 2 * part.shape[-1]) for part in memory[:4]), *memory[4:])
