"""Packets of states and of coded states over given events, for the tests of flipped acknowledgements; covariances only."""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.process import Process
from evedrop.model.receiver import Flags, Reception
from evedrop.model.reference_code import ReferenceCode, ReferenceReceiver
from evedrop.model.schemes.mixed_packets import MixedEncoder


@final
class GivenEncoder(MixedEncoder):
    """Sends the state where it is told to; plain: (slots, R)."""

    def __init__(self, code: ReferenceCode, n: int, plain: np.ndarray) -> None:
        super().__init__(code, n, plain.shape[1])
        self._given = plain

    def plain(self, k: int) -> Flags:
        """Whether the state is sent in slot k, (R,)."""
        flags: Flags = self._given[k]
        return flags


def covariances(
    process: Process, plain: np.ndarray, acks: np.ndarray, heard: np.ndarray, open_loop: bool = False
) -> np.ndarray:
    """The optimal reader's P, (slots, n, n, R), over given events, all (slots, R)."""
    slots, trials = plain.shape
    encoder = GivenEncoder(ReferenceCode(process, open_loop), process.n, plain)
    receiver = ReferenceReceiver(process, trials, open_loop)
    belief, nothing, covariances = receiver.prior(), np.zeros((process.n, trials)), []
    for k in range(slots):
        packet = encoder.encode(k, nothing, nothing)
        belief = receiver.step(k, belief, Reception(heard[k], nothing, packet.header))
        encoder.acknowledged(k, acks[k])
        covariances.append(belief.P)
    return np.array(covariances)
