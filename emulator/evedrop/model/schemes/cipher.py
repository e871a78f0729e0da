"""Stream cipher: every packet is the state under a pad that only sensor and estimator can draw; the model takes it for ideal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from evedrop.model.number_codes import Mask
from evedrop.model.packet_user import StateReader
from evedrop.model.process import MARGINAL, Floats, Process
from evedrop.model.receiver import Flags, Reception, select
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, PacketBlock, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import Outcomes, state_covariances, traces_of_slots
from evedrop.model.theory.leaked_bits import RevealedBits


class CipherEncoder(Encoder):
    """z_k = x_k, masked."""

    def __init__(self, mask: Mask) -> None:
        self._mask = mask

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        return Packet(self._mask.hide(k, x), np.zeros(x.shape[1], np.bool_))


def encrypted_packets(heard: Reception) -> Flags:
    """Whether a packet was received that is encrypted, (R,): 1 in its header, or no header, says so."""
    return heard.gamma if heard.header is None else heard.gamma & (heard.header[0] == 1)


class CipherEstimator(StateReader):
    """Unmasks the packets that are masked, and has the state from every packet."""

    def __init__(self, process: Process, trials: int, mask: Mask) -> None:
        super().__init__(process, trials)
        self._mask = mask

    def read(self, k: int, heard: Reception) -> Floats:
        """The packet, unmasked where its header says that it is masked."""
        encrypted = encrypted_packets(heard)
        masked = np.where(encrypted, heard.z, 0.0)
        return select(encrypted, lambda: self._mask.reveal(k, masked), lambda: heard.z)


class Cipher(Scheme):
    """Masks every packet. Packets are independent of the state, so an eavesdropper can do no better than not to listen.

    Source: docs/mathematics/schemes.md, stream cipher.
    """

    sent_words = ("encrypted state",)
    best_reader = "constant"
    secret_streams = ("mask",)
    estimator_streams = ("mask",)
    secret_words = (0, 1)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The pads."""
        mask = Mask(self.process, keys["mask"], batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: CipherEncoder(mask),
            lambda: CipherEstimator(self.process, batch.trials, mask),
        )

    def encrypted(self, packets: PacketBlock) -> Flags:
        """All, (c, R)."""
        return np.ones(packets.nu.shape, np.bool_)

    def error_floor(self, slots: int) -> tuple[Floats, bool]:
        """Tr Σ_k, (slots,): nothing can be learnt from packets. It grows unless A forgets.

        Source: docs/mathematics/model.md, model.
        """
        return traces_of_slots(state_covariances(self.process, slots)), self.process.spectral_radius >= 1.0 - MARGINAL

    def revealed_bits(self) -> RevealedBits:
        """Nothing."""
        return RevealedBits(0.0, 0.0)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet."""
        return Outcomes.plain(mu)
