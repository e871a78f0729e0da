"""The paper's scheme: the state, or a one-step innovation hidden in noise that makes it look like the state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from emulator.model.process import Floats, Process, StateFactors, product
from emulator.model.receiver import Action, Belief, Flags, Receiver, select
from emulator.model.schedule import Schedule
from emulator.model.schemes.scheme import Encoder, Packet, Scheme
from emulator.streams import Batch, BlockReader


class Shared(NamedTuple):
    """What sensor and legitimate estimator share about a slot, for R trials."""

    nu: Flags
    """ν_k, (R,): true for an innovation."""
    chi: Floats
    """χ_k ~ N(0, A Σ_{k−1} Aᵀ), (n, R); 0 at k = 0."""


class SharedSecret:
    """(ν_k, χ_k) of every slot, from the streams `schedule` and `noise`.

    Final. χ_k = A L_{k−1} ξ_k with L L ᵀ = Σ_{k−1} factored by QR. Addressed by slot: a lost packet desynchronises
    nobody.

    Source: docs/mathematics.md, encoding noise.
    """

    def __init__(self, process: Process, state_probability: float, keys: Mapping[str, bytes], batch: Batch) -> None:
        self._schedule = Schedule(keys["schedule"], state_probability, batch)
        self._reader = BlockReader(keys["noise"], batch, process.n)
        self._factors = StateFactors(process)
        self._n = process.n
        self._slots = range(0)
        self._chi: Floats

    def at(self, k: int) -> Shared:
        """The secret of slot k."""
        if k not in self._slots:
            self._slots = self._reader.block(k)
            zero = [[0.0] * self._n for _ in range(self._n)]
            factors = np.array([self._factors.carried(slot) if slot else zero for slot in self._slots])
            self._chi = product(factors, self._reader.normals(self._slots))
        return Shared(self._schedule.at(k), self._chi[k - self._slots.start])


class InnovationEncoder(Encoder):
    """z_k = x_k, or x_k − A x_{k−1} + χ_k where ν_k = 1.

    Source: the paper's encoding mechanism, and docs/mathematics.md, model.
    """

    def __init__(self, secret: SharedSecret) -> None:
        self._secret = secret

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k."""
        nu, chi = self._secret.at(k)
        return Packet(select(nu, lambda: (x - predicted) + chi, lambda: x), nu)


class InnovationEstimator(Receiver):
    """The exact MMSE estimator that holds the secret.

    Source: Theorem IV.1 (covariance) and docs/mathematics.md, legitimate estimator.
    """

    def __init__(self, process: Process, trials: int, secret: SharedSecret) -> None:
        super().__init__(process, trials)
        self._secret = secret

    def step(self, k: int, belief: Belief, gamma: Flags, z: Floats) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, (z, 0) for the state, (A x̂ + z − χ, A P Aᵀ) for an innovation."""
        nu, chi = self._secret.at(k)
        state, innovation = gamma & ~nu, gamma & nu

        def estimate() -> Floats:
            predicted = self.predicted(k, belief.x_hat)
            return select(innovation, lambda: predicted + (z - chi), lambda: predicted)

        def covariance() -> Floats:
            carried = self.carried(k, belief.P)
            return select(innovation, lambda: carried, lambda: self.diffused(k, carried))

        return Belief(
            select(state, lambda: z, estimate),
            select(state, lambda: np.zeros_like(belief.P), covariance),
            _ACTIONS[gamma.view(np.uint8) + innovation.view(np.uint8)],
        )


_ACTIONS = np.array([Action.LOST, Action.STATE, Action.INNOVATION], np.uint8)


class Innovation(Scheme):
    """The paper's scheme; needs no acknowledgements."""

    secret_streams = ("schedule", "noise")
    mixes = True

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:
        """The sensor's side."""
        return InnovationEncoder(SharedSecret(self.process, self.state_probability, keys, batch))

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:
        """The legitimate estimator's side."""
        secret = SharedSecret(self.process, self.state_probability, keys, batch)
        return InnovationEstimator(self.process, batch.trials, secret)
