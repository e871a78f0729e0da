"""The selective eavesdropper: uses what is sent in clear, and leaves alone what the header says is encrypted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from emulator.model import update
from emulator.model.eavesdroppers.eavesdropper import Eavesdropper
from emulator.model.receiver import Action, Belief, Flags, Heard


class Selective(Eavesdropper):
    """b_k = 1 where the header is 0, or missing; it is given nothing.

    Meant for the scheme `encrypted-schedule` alone, against which it is the best there is.

    Source: docs/mathematics.md, schedules by holding time.
    """

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, float]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Of a state in clear, certain; innovations are not sent to it."""
        return 1.0, 0.0

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - the header decides
        """All that is in clear."""
        return None

    def step(self, k: int, belief: Belief, heard: Heard) -> Belief:
        """A x̂ and A P Aᵀ + Q, or z and 0 where a packet is in clear."""
        action = self.act(k, heard.gamma)
        if heard.header is not None:
            action = np.where(heard.gamma & (heard.header[0] != 0), np.uint8(Action.DISCARDED), action)
        return Belief(
            update.estimate(self.process, k, belief.x_hat, action, heard.z),
            update.believed_covariance(self.process, k, belief.P, action),
            action,
        )
