"""What the schemes for flipped acknowledgements have in common: packets of states and of coded states, with the reference named.

Source: docs/mathematics.md, flipped acknowledgements.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.reference import Content
from evedrop.model.reference_code import NONE
from evedrop.model.schemes.acknowledged import AcknowledgedEncoder
from evedrop.model.schemes.scheme import Packet

MIXED_HEADER = (
    "slot t of the reference; −1: no reference",
    "0: z is the state; 1: z is the state minus L_{t,k} x_t",
)
"""The header of these schemes. A packet with the state names the reference too, so that receivers follow it."""


class MixedEncoder(AcknowledgedEncoder):
    """z_k = x_k where a policy says so or there is no reference, else x_k − L_{t,k} x_t, t the last acknowledged slot."""

    @abstractmethod
    def plain(self, k: int) -> Flags:
        """Whether the state is sent in slot k, (R,), if there is a reference."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, which must follow the slot before."""
        packet = super().encode(k, x, predicted)
        self._sent_plain = self.plain(k) | (self._slot == NONE)
        self._read = np.where(self._sent_plain, x, self._read)
        content = np.where(self._sent_plain, Content.STATE, Content.CODED)
        return packet._replace(z=np.where(self._sent_plain, x, packet.z), header=np.array([self._slot, content]))
