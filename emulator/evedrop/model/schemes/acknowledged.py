"""State-secrecy codes: the state minus a state that the legitimate estimator is known to have from its acknowledgements.

With L = A, for comparison, an eavesdropper that lost the reference learns the stable modes again.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import final

import numpy as np

from evedrop.model.process import Floats, product
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.reference_code import NONE, Content, ReferenceCode, ReferenceReceiver, singular_warnings
from evedrop.model.reference_form import ReferenceForm
from evedrop.model.schemes.scheme import Encoder, Packet, PublicScheme
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_forms import LostReference, ReceiverConditions, growth_by_coin
from evedrop.model.theory.covariances import Outcomes


class AcknowledgedEncoder(Encoder):
    """z_k = x_k − L_{t,k} x_t, with t the last acknowledged slot; x_k itself before the first acknowledgement."""

    def __init__(self, code: ReferenceCode, n: int, trials: int) -> None:
        self._code = code
        self._reference = np.zeros((n, trials))
        self._slot = np.full(trials, NONE, np.int64)
        self._k = NONE
        self._read: Floats

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - references say more
        """The packet of slot k, which must follow the slot before."""
        if k:
            self._slot = np.where(self._slot >= self._code.oldest(k), self._slot, NONE)
            self._reference = product(self._code.at(k), np.where(self._slot == NONE, 0.0, self._reference))
        # Where there is no reference, 0 is subtracted: x − 0 is x.
        z = x - self._reference
        # The state to the last bit as the estimator reads it: the rounding of x would grow with each reference made from another.
        self._k, self._read = k, z + self._reference
        return Packet(z, np.zeros(x.shape[1], np.bool_), self._slot[None].copy())

    def acknowledged(self, k: int, acknowledged: Flags) -> None:
        """Make x_k the reference where slot k is acknowledged. Raises ValueError if k is not the slot just sent."""
        if k != self._k:
            raise ValueError(f"acknowledgements of slot {k} after slot {self._k} was sent; expected those of that slot")
        self._reference = np.where(acknowledged, self._read, self._reference)
        self._slot = np.where(acknowledged, k, self._slot)


class ReferenceScheme(PublicScheme):
    """Subtracts a reference that the legitimate estimator has, as its acknowledgements show."""

    best_reader = "reference"
    needs_acknowledgements = True
    reads_packets = True

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """A receiver that keeps the references it may have acknowledged."""
        return ReferenceReceiver(self.process, batch.trials)


class _AcknowledgedReferences(ReferenceScheme):
    """Subtracts the reference whenever there is one."""

    sent_words = ("coded state",)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet, whichever acknowledgements arrive."""
        return Outcomes.plain(mu)

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference:  # noqa: ARG002 - it lasts
        """Nothing ends the growth: no later packet reveals the reference."""
        remedy = "random-code or threshold-code is used, which send the state now and then"
        return LostReference(growth_by_coin(self.process, 0.0, received), remedy)


def _reference_form(scheme: Acknowledged, conditions: ReceiverConditions) -> ReferenceForm | None:
    return ReferenceForm.of(scheme.process, conditions, open_loop=False)


class Acknowledged(_AcknowledgedReferences):
    """Subtracts a reference that the legitimate estimator has; an eavesdropper that missed a reference can never recover it.

    The reference is carried so that a packet is independent of the state it is sent for, unless A is singular. There is no
    secret: receivers differ only in which packets they heard, and the sensor knows that of one of them. The scheme therefore
    depends on acknowledgements that are neither blocked nor forged.

    Source: Tsiamis, Gatsis, Pappas (2018, 2020); docs/mathematics/schemes.md, acknowledged references.
    """

    closed_forms = MappingProxyType({"legitimate": _reference_form, "reference": _reference_form})
    lost_reference = _AcknowledgedReferences.lost_reference
    header = ("slot t of the reference; −1: none, z is the state",)

    def warnings(self) -> list[str]:
        """That of a singular A."""
        return singular_warnings(self.process)

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:  # noqa: ARG002 - there is no secret
        """Carries the reference by L."""
        return AcknowledgedEncoder(ReferenceCode(self.process), self.process.n, batch.trials)


@final
class OpenLoopEncoder(AcknowledgedEncoder):
    """z_k = x_k − A^{k−t} x_t, with t the last acknowledged slot; x_k itself before the first acknowledgement."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, which must follow the slot before."""
        packet = super().encode(k, x, predicted)
        assert packet.header is not None  # noqa: S101 - it is the base class's packet
        content = np.where(packet.header == NONE, Content.STATE, Content.OPEN_LOOP)
        return packet._replace(header=np.concatenate([packet.header, content]))


def _open_loop_form(scheme: OpenLoop, conditions: ReceiverConditions) -> ReferenceForm | None:
    return ReferenceForm.of(scheme.process, conditions, open_loop=True)


class OpenLoop(_AcknowledgedReferences):
    """Subtracts a reference that the estimator has, carried by A; an eavesdropper that missed it follows the stable modes later.

    Source: Tsiamis, Gatsis, Pappas (2018, 2020); docs/mathematics/schemes.md, acknowledged references.
    """

    closed_forms = MappingProxyType({"legitimate": _open_loop_form, "reference": _open_loop_form})
    lost_reference = _AcknowledgedReferences.lost_reference
    header = ("slot t of the reference; −1: no reference", "0: z is the state; 2: z is the state minus A^{k−t} x_t")

    def encoder(self, keys: Mapping[str, bytes], batch: Batch) -> Encoder:  # noqa: ARG002 - there is no secret
        """Carries the reference by A."""
        return OpenLoopEncoder(ReferenceCode(self.process, open_loop=True), self.process.n, batch.trials)
