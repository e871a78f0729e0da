"""Encryption scheduling: packets are unencrypted while the legitimate estimator keeps up, encrypted when it has fallen behind.

Quantised packets may have a threshold between two whole numbers, so that the schedule meets an energy budget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model.checks import MOST_SLOTS, number_mistakes, whole_number_mistakes
from evedrop.model.number_codes import MOST_BITS, DitheredQuantiser, LevelPad, Mask
from evedrop.model.packet_user import StateReader
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Belief, Flags, Reception, select
from evedrop.model.schemes.cipher import CipherEstimator, encrypted_packets
from evedrop.model.schemes.scheme import NoInnovations, Packet, PacketBlock, Scheme, Shared
from evedrop.model.schemes.silent import HoldingTimeEncoder
from evedrop.model.streams import Ahead, Batch, BlockReader
from evedrop.model.theory.closed_forms import (
    ChainForm,
    QuantisationError,
    ReceiverConditions,
    always_sent,
    encrypted_schedule,
)
from evedrop.model.theory.covariances import LARGEST_OPERATOR, Outcomes


class EncryptedScheduleEncoder(HoldingTimeEncoder):
    """z_k = x_k, masked from `threshold` slots after the last acknowledged slot on; the header tells whether."""

    def __init__(self, threshold: float, trials: int, mask: Mask) -> None:
        super().__init__(trials)
        self._threshold, self._mask = threshold, mask

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        encrypted = self._held.reached(k, self._threshold)
        z = select(encrypted, lambda: self._mask.hide(k, x), lambda: x)
        return Packet(z, np.zeros(x.shape[1], np.bool_), encrypted.astype(np.int64)[None])


def _selective_form(scheme: _EncryptsByHoldingTime, conditions: ReceiverConditions) -> ChainForm | None:
    """That of a reader of the unencrypted packets; None if the chain, with a state for each holding time, is too long."""
    received, acknowledged, threshold = conditions.received, conditions.acknowledged, scheme.threshold
    if received is None or acknowledged is None or conditions.hijack is not None or threshold > LARGEST_OPERATOR:
        return None
    chain = encrypted_schedule(threshold, received, acknowledged)
    return ChainForm(scheme.process, conditions.slots, chain, scheme.quantisation)


class _EncryptsByHoldingTime(Scheme):
    """Encrypts from a holding time of `threshold` on; the header tells."""

    sent_words = ("state",)
    best_reader = "selective"
    needs_acknowledgements = True
    header = ("1 if encrypted, 0 if unencrypted",)
    secret_words = (0, 1)
    threshold: float

    def encrypted(self, packets: PacketBlock) -> Flags:
        """Those whose header says so, (c, R)."""
        assert packets.header is not None  # noqa: S101 - every packet of such a scheme has one
        flags: Flags = packets.header[:, 0] == 1
        return flags


class EncryptedSchedule(_EncryptsByHoldingTime):
    """Encrypts from `threshold` slots after the last acknowledged slot until the next acknowledgement; with 1, always.

    For a sensor that can afford to encrypt only some packets. Where acknowledgements are blocked it encrypts all of them,
    which costs more than intended but preserves secrecy.

    Source: after Huang, Ding, Leong, Quevedo, Shi (2021); docs/mathematics/schemes.md, schedules by holding time.
    """

    closed_forms = MappingProxyType({"selective": _selective_form})
    parameters = MappingProxyType({"threshold": 2})
    secret_streams = ("mask",)
    estimator_streams = ("mask",)

    def __init__(self, process: Process, threshold: int) -> None:
        super().__init__(process)
        self.threshold = threshold

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold is a number of slots."""
        return whole_number_mistakes(given, "threshold", 1, MOST_SLOTS)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The pads."""
        mask = Mask(self.process, keys["mask"], batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: EncryptedScheduleEncoder(self.threshold, batch.trials, mask),
            lambda: CipherEstimator(self.process, batch.trials, mask),
        )

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet."""
        return Outcomes.plain(mu)


_WIDEST = 100.0  # standard deviations
_NEGLECTED = 1e-9  # of a state's variance


def _overload(r: float) -> float:
    """The mean square by which a standard normal variable exceeds ±r: 2(1 + r²)Φ(−r) − 2rφ(r)."""
    density = math.exp(-0.5 * r * r) / math.sqrt(2.0 * math.pi)
    return (1.0 + r * r) * math.erfc(r / math.sqrt(2.0)) - 2.0 * r * density


@final
class QuantisedScheduleEncoder(HoldingTimeEncoder):
    """Sends the number that is read from the level of x_k; from the threshold on, the middle of the masked level.

    The header tells which.

    At a holding time of ⌊θ⌋ the packet is masked with probability 1 − (θ − ⌊θ⌋), by the stream `threshold`.
    """

    def __init__(self, threshold: float, batch: Batch, quantiser: DitheredQuantiser, pad: LevelPad, key: bytes) -> None:
        super().__init__(batch.trials)
        self._least, self._most = math.floor(threshold), math.ceil(threshold)
        early = 1.0 - (threshold - self._least)
        self._quantiser, self._pad = quantiser, pad
        reader = BlockReader(key, batch, 1)
        self._early = Ahead(reader.ahead, lambda slots: reader.uniforms(slots)[:, 0, :] < early)

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        encrypted = self._held.reached(k, self._most) | (self._held.reached(k, self._least) & self._early.at(k))
        levels = self._quantiser.levels(k, x)
        masked = self._quantiser.centres(k, self._pad.hide(k, levels))
        z = np.where(encrypted, masked, self._quantiser.read(k, levels))
        return Packet(z, np.zeros(x.shape[1], np.bool_), encrypted.astype(np.int64)[None])


@final
class QuantisedScheduleEstimator(StateReader):
    """Reads every packet; the value read has the error of the quantiser, of covariance R_k = diag(Δ²)/12."""

    def __init__(self, process: Process, trials: int, quantiser: DitheredQuantiser, pad: LevelPad) -> None:
        super().__init__(process, trials)
        self._quantiser, self._pad = quantiser, pad

    def read(self, k: int, heard: Reception) -> Floats:
        """The value of the level, which is unmasked first where the header says that it is masked."""
        encrypted = encrypted_packets(heard)
        masked = self._quantiser.levels_of(k, np.where(encrypted, heard.z, 0.0))
        return np.where(encrypted, self._quantiser.read(k, self._pad.reveal(k, masked)), heard.z)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """(A x̂, A P Aᵀ + Q) if lost, otherwise (the value read, R_k)."""
        after = super().step(k, belief, heard)
        steps = self._quantiser.steps(k)
        error = np.diag(steps * steps / 12.0)
        return after._replace(P=after.P + np.where(heard.gamma, error[:, :, None], 0.0))


def _always_read(scheme: QuantisedSchedule, conditions: ReceiverConditions) -> ChainForm | None:
    """That of the legitimate estimator, which reads every packet."""
    received = conditions.received
    if received is None or conditions.acknowledged is None or scheme.threshold > LARGEST_OPERATOR:
        return None
    return ChainForm(scheme.process, conditions.slots, always_sent(received), scheme.quantisation)


class QuantisedSchedule(_EncryptsByHoldingTime):
    """Quantises the state with subtractive dither, and encrypts as `encrypted-schedule` does, from a threshold θ on.

    θ need not be whole: at a holding time of ⌊θ⌋ a coin decides, so that any energy budget between that of unencrypted packets
    and that of a cipher is met exactly. The dither is public: an unencrypted packet is shown as the number that is read from it.

    Source: Huang, Ding, Leong, Quevedo, Shi (2021); docs/mathematics/schemes.md, quantised packets.
    """

    closed_forms = MappingProxyType({"legitimate": _always_read, "selective": _selective_form})
    meets_energy_budget = True
    parameters = MappingProxyType({"threshold": 1.5, "bits": 8, "standard_deviations": 6.0})
    secret_streams = ("dither", "mask", "threshold")
    estimator_streams = ("dither", "mask")
    reads_packets = True

    def __init__(self, process: Process, threshold: float, bits: int, standard_deviations: float) -> None:
        super().__init__(process)
        self.threshold, self._width, self._standard_deviations = threshold, bits, standard_deviations

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold below 1, a number of bits that is not whole, or a range that is empty."""
        return [
            *number_mistakes(given, "threshold", 1.0, MOST_SLOTS),
            *whole_number_mistakes(given, "bits", 1, MOST_BITS),
            *number_mistakes(given, "standard_deviations", 1.0, _WIDEST),
        ]

    def warnings(self) -> list[str]:
        """Where theory neglects too much: states beyond the quantiser's range."""
        error, r = self.quantisation.fraction, self._standard_deviations
        overload = _overload(r)
        if overload <= max(_NEGLECTED, 0.01 * error):
            return []
        return [
            f"encoding.standard_deviations is {r:g}: a state exceeds the quantiser's range with a probability of up to "
            f"{math.erfc(r / math.sqrt(2.0)):.2g} a slot, which adds {overload / error:.3g} times the quantiser's own error; "
            "theory neglects it, so measured errors are larger than expected; 6 or more prevents that"
        ]

    @property
    def payload_bits(self) -> int:
        """A level for each state."""
        return self._width * self.process.n

    @property
    def header_bits(self) -> int:
        """One: whether the packet is encrypted."""
        return 1

    @property
    def quantisation(self) -> QuantisationError:
        """The error of the value read."""
        return QuantisationError.of(self._width, self._standard_deviations)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The quantiser and the pads."""
        quantiser = DitheredQuantiser(self.process, self._width, self._standard_deviations, keys["dither"], batch)
        pad = LevelPad(self.process.n, self._width, keys["mask"], batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: QuantisedScheduleEncoder(self.threshold, batch, quantiser, pad, keys["threshold"]),
            lambda: QuantisedScheduleEstimator(self.process, batch.trials, quantiser, pad),
        )

    def outcomes(self, mu: float) -> None:
        """None: a packet that is read leaves the error of the quantiser."""
