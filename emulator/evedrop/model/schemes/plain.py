"""No encoding: every packet is the state. The baseline, which keeps nothing secret."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from evedrop.model.packet_user import PacketUser
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.leaked_bits import RevealedBits


class PlainEncoder(Encoder):
    """z_k = x_k."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(x, np.zeros(x.shape[1], np.bool_))


class PlainEstimator(PacketUser):
    """Uses every packet it receives: E P → (1−μ) S(μ)."""

    def uses_block(self, slots: range) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Always."""
        return None


class Plain(Scheme):
    """Every packet is the state, μ_d = 1; there is no secret."""

    sent_words = ("state",)
    sends_states_and_innovations = True

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:  # noqa: ARG002 - there is no secret
        """Nothing."""
        trials = batch.trials
        return NoInnovations(self.process, trials, PlainEncoder, lambda: PlainEstimator(self.process, trials))

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet."""
        return Outcomes.plain(mu)

    def revealed_bits(self) -> RevealedBits:
        """The state."""
        return RevealedBits(math.inf, 0.0)

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes:
        """As in the paper, with μ_d = 1."""
        return Outcomes.eavesdropper(mu_e, 1.0, use_state, use_innovation)
