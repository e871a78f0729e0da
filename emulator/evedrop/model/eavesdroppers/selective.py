"""The selective eavesdropper: uses packets sent unencrypted, and ignores those that are encrypted according to the header."""

from __future__ import annotations

import numpy as np

from evedrop.model import update
from evedrop.model.eavesdroppers.eavesdropper import PacketReader
from evedrop.model.receiver import Action, Belief, Reception


class Selective(PacketReader):
    """b_k = 1 where the header is 0, or missing; it needs no knowledge.

    Intended only for the schemes `encrypted-schedule`, against which it is optimal, and `quantised-schedule`, whose quantiser
    it takes for exact.

    Source: docs/mathematics.md, schedules by holding time and quantised packets.
    """

    only_against = (
        ("encrypted-schedule", "quantised-schedule"),
        "reads a header that says which packets are encrypted, and there is none: it is the same as naive here",
    )

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """A x̂ and A P Aᵀ + Q, or z and 0 where a packet is unencrypted."""
        # The codes 0 and 1 of `Action` are γ itself: the state where a packet arrives.
        action = heard.gamma.astype(np.uint8)
        if heard.header is not None:
            action = np.where(heard.gamma & (heard.header[0] != 0), np.uint8(Action.DISCARDED), action)
        return update.belief(self.process, k, belief, action, heard.z)
