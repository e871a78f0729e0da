"""Encryption scheduling: unencrypted packets while the user keeps up, encrypted when it has fallen behind."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import count_mistakes
from evedrop.model.holding_time import HoldingTime
from evedrop.model.numeric.masking import Mask
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Flags, select
from evedrop.model.schemes.cipher import CipherEstimator
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, PacketBlock, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.chain_form import ChainForm
from evedrop.model.theory.closed_form import ReceiverConditions
from evedrop.model.theory.closed_forms import encrypted_schedule
from evedrop.model.theory.covariances import LARGEST_OPERATOR, Outcomes


def encrypted_by_header(packets: PacketBlock) -> Flags:
    """Whether the first number of each packet's header is 1, (c, R)."""
    assert packets.header is not None  # noqa: S101 - every packet of such a scheme has one
    flags: Flags = packets.header[:, 0] == 1
    return flags


class EncryptedScheduleEncoder(Encoder):
    """z_k = x_k, masked from `threshold` slots after the last acknowledged slot on; the header tells whether."""

    def __init__(self, threshold: int, trials: int, mask: Mask) -> None:
        self._threshold = threshold
        self._held = HoldingTime(trials)
        self._mask = mask

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        encrypted = self._held.reached(k, self._threshold)
        z = select(encrypted, lambda: self._mask.hide(k, x), lambda: x)
        return Packet(z, np.zeros(x.shape[1], np.bool_), encrypted.astype(np.int64)[None])

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Send unencrypted again where slot k is acknowledged."""
        self._held.acknowledged(k, acknowledged)


def selective_form(scheme: Scheme, threshold: float, conditions: ReceiverConditions) -> ChainForm | None:
    """That of a reader of the unencrypted packets; None if the chain, with a state for each holding time, is too long."""
    received, acknowledged = conditions.received, conditions.acknowledged
    if received is None or acknowledged is None or conditions.hijack is not None or threshold > LARGEST_OPERATOR:
        return None
    chain = encrypted_schedule(threshold, received, acknowledged)
    return ChainForm(scheme.process, conditions.slots, chain, scheme.quantisation)


def _selective_form(scheme: EncryptedSchedule, conditions: ReceiverConditions) -> ChainForm | None:
    return selective_form(scheme, scheme.threshold, conditions)


class EncryptedSchedule(Scheme):
    """Encrypts from `threshold` slots after the last acknowledged slot until the next acknowledgement; with 1, always.

    For a sensor that can afford to encrypt only some packets. Where acknowledgements are blocked it encrypts all of them,
    which costs more than intended but preserves secrecy.

    Source: after Huang, Ding, Leong, Quevedo, Shi (2021); docs/mathematics.md, schedules by holding time.
    """

    best_reader = "selective"
    closed_forms = MappingProxyType({"selective": _selective_form})
    parameters = MappingProxyType({"threshold": 2})
    secret_streams = ("mask",)
    estimator_streams = ("mask",)
    needs_acknowledgements = True
    header = ("1 if encrypted, 0 if unencrypted",)
    secret_words = (0, 1)

    def __init__(self, process: Process, threshold: int) -> None:
        super().__init__(process)
        self.threshold = threshold

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold is a number of slots."""
        return count_mistakes(given, "threshold")

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The pads."""
        mask = Mask(self.process, keys["mask"], batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: EncryptedScheduleEncoder(self.threshold, batch.trials, mask),
            lambda: CipherEstimator(self.process, batch.trials, mask),
        )

    def encrypted(self, packets: PacketBlock) -> Flags:
        """Those whose header says so, (c, R)."""
        return encrypted_by_header(packets)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet."""
        return Outcomes.plain(mu)
