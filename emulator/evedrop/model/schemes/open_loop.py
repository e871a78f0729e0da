"""State-secrecy code with L = A, for comparison: an eavesdropper that lost the reference learns the stable modes again."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Receiver
from evedrop.model.reference import Content, ReferenceReceiver
from evedrop.model.reference_code import NONE, ReferenceCode
from evedrop.model.reference_form import ReferenceForm
from evedrop.model.schemes.acknowledged import AcknowledgedEncoder
from evedrop.model.schemes.scheme import NoInnovations, Packet, Scheme, Shared
from evedrop.model.streams import Batch
from evedrop.model.theory.closed_form import ReceiverConditions
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.lost_reference import LostReference, growth_by_coin


@final
class OpenLoopEncoder(AcknowledgedEncoder):
    """z_k = x_k − A^{k−t} x_t, with t the last acknowledged slot; x_k itself before the first acknowledgement."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """The packet of slot k, which must follow the slot before."""
        packet = super().encode(k, x, predicted)
        assert packet.header is not None  # noqa: S101 - it is the base class's packet
        content = np.where(packet.header == NONE, Content.STATE, Content.OPEN_LOOP)
        return packet._replace(header=np.concatenate([packet.header, content]))


def _reference_form(scheme: OpenLoop, conditions: ReceiverConditions) -> ReferenceForm | None:
    return ReferenceForm.of(scheme.process, conditions, open_loop=True)


class OpenLoop(Scheme):
    """Subtracts a reference that the user has, carried by A; an eavesdropper that missed it follows the stable modes later.

    Source: Tsiamis, Gatsis, Pappas (2018, 2020); docs/mathematics.md, acknowledged references.
    """

    best_reader = "reference"
    closed_forms = MappingProxyType({"legitimate": _reference_form, "reference": _reference_form})
    needs_acknowledgements = True
    reads_packets = True
    header = ("slot t of the reference; −1: no reference", "0: z is the state; 2: z is the state minus A^{k−t} x_t")

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The references; nothing is secret."""
        code = ReferenceCode(self.process, open_loop=True)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: OpenLoopEncoder(code, self.process.n, batch.trials),
            lambda: self.estimator(keys, batch),
        )

    def estimator(self, keys: Mapping[str, bytes], batch: Batch) -> Receiver:  # noqa: ARG002 - there is no secret
        """A receiver that keeps the references it may have acknowledged."""
        return ReferenceReceiver(self.process, batch.trials)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet, whichever acknowledgements arrive."""
        return Outcomes.plain(mu)

    def lost_reference(self, received: float, acknowledged: tuple[float, float]) -> LostReference:  # noqa: ARG002 - it lasts
        """Nothing ends the growth: no later packet reveals the reference."""
        remedy = "random-code or threshold-code is used, which send the state now and then"
        return LostReference(growth_by_coin(self.process, 0.0, received), remedy)
