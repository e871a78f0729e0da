"""The paper's scheme: the state, or a one-step innovation hidden in noise that makes it look like the state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model import update
from evedrop.model.checks import probabilities_mistakes
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process, StateFactors, product
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Receiver
from evedrop.model.schedule import Schedule, StateProbability
from evedrop.model.schemes.scheme import Encoder, PacketBlock, Scheme, Shared
from evedrop.model.staircase import is_nonsingular
from evedrop.model.streams import Ahead, Batch, BlockReader
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.leaked_bits import LeakedBits, RevealedBits


@final
class SharedSecret(Shared):
    """ν_k and χ_k of every slot, from the streams `schedule` and `noise`.

    χ_k = A L_{k−1} ξ_k with L Lᵀ = Σ_{k−1} factored by QR. Both are addressed by slot, so a lost packet desynchronises
    no one. Noise is drawn only where it is needed.

    Source: docs/mathematics/numerics.md, encoding noise.
    """

    def __init__(
        self, process: Process, state_probability: StateProbability, keys: Mapping[str, bytes], batch: Batch
    ) -> None:
        self._schedule = Schedule(keys["schedule"], state_probability, batch)
        self._reader = BlockReader(keys["noise"], batch, process.n)
        self._factors = StateFactors(process)
        self._process = process
        self._trials = batch.trials
        self._chi = Ahead(self._reader.ahead, self._drawn)

    def nu(self, k: int) -> Flags:
        """ν_k, (R,): true for an innovation."""
        return self._schedule.at(k)

    def chi(self, k: int) -> Floats:
        """χ_k ~ N(0, A Σ_{k−1} Aᵀ), (n, R); 0 at k = 0."""
        return self._chi.at(k)

    def nu_block(self, slots: range) -> Flags:
        """ν of consecutive slots, (c, R)."""
        return self._schedule.block(slots)

    def chi_block(self, slots: range) -> Floats:
        """χ of consecutive slots, (c, n, R)."""
        return self._chi.of(slots)

    def _drawn(self, slots: range) -> Floats:
        return product(self._factors.block(slots), self._reader.normals(slots))

    def encoder(self) -> Encoder:
        """The sensor's side."""
        return InnovationEncoder(self)

    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""
        return InnovationEstimator(self._process, self._trials, self)


class InnovationEncoder(Encoder):
    """z_k = x_k, or x_k − A x_{k−1} + χ_k where ν_k = 1.

    Source: the paper's encoding mechanism, and docs/mathematics/model.md, model.
    """

    def __init__(self, secret: SharedSecret) -> None:
        self._secret = secret

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> PacketBlock:
        """The packets of consecutive slots."""
        nu = self._secret.nu_block(slots)
        return PacketBlock(kernels.encode(nu, x, predicted, self._secret.chi_block(slots)), nu)


class InnovationEstimator(Receiver):
    """The exact MMSE estimator with the secret.

    Source: Theorem IV.1 (covariance) and docs/mathematics/model.md, legitimate estimator.
    """

    def __init__(self, process: Process, trials: int, secret: SharedSecret) -> None:
        super().__init__(process, trials)
        self._secret = secret

    def act(self, k: int, gamma: Flags) -> Codes:
        """Lost, used as the state, or decoded, by the schedule."""
        # The codes 0, 1, 2 of `Action` are these sums: LOST, STATE where γ, INNOVATION where γ and ν.
        return gamma.view(np.uint8) + (gamma & self._secret.nu(k)).view(np.uint8)

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """(A x̂, A P Aᵀ + Q) if lost, (z, 0) for the state, (A x̂ + z − χ, A P Aᵀ) for an innovation."""
        action = gamma.view(np.uint8) + (gamma & self._secret.nu_block(slots)).view(np.uint8)
        beliefs = update.beliefs(self.process, slots.start, belief, action, z, self._secret.chi_block(slots))
        return beliefs, beliefs.last


class Innovation(Scheme):
    """The paper's scheme, which needs no acknowledgements. `state_probability` is μ_d, or a list with μ_d(k) of each slot."""

    best_reader = "bayesian"
    sends_states_and_innovations = True
    parameters = MappingProxyType({"state_probability": 0.6})
    secret_streams = ("schedule", "noise")
    estimator_streams = ("schedule", "noise")
    secret_words = (1, 1)

    def __init__(self, process: Process, state_probability: float | Sequence[float]) -> None:
        super().__init__(process, state_probability)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """μ_d is a probability, or a list of probabilities."""
        return probabilities_mistakes(given, "state_probability")

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """Schedule and noise."""
        return SharedSecret(self.process, self.mu_d, keys, batch)

    def revealed_bits(self) -> RevealedBits | None:
        """The state, or what an innovation leaks; None if A is singular, for an innovation then shows a part of w itself."""
        if not is_nonsingular(self.process.A):
            return None
        return RevealedBits(math.inf, LeakedBits(self.process))

    def outcomes(self, mu: float) -> Outcomes:
        """Theorem IV.1."""
        return Outcomes.legitimate(mu, self.state_probability)

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes:
        """Lemma V.1."""
        return Outcomes.eavesdropper(mu_e, self.state_probability, use_state, use_innovation)
