"""The eavesdropper of references: reads state-secrecy codes with the references that it heard itself."""

from __future__ import annotations

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketReader
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Reception
from evedrop.model.reference import ReferenceReceiver
from evedrop.model.streams import Batch


class Reference(PacketReader):
    """Follows the headers as the legitimate estimator does; it needs no knowledge, because the code has no secret.

    Intended only for the schemes `acknowledged`, `open-loop`, `random-code` and `threshold-code`, against which it is optimal.

    Source: docs/mathematics.md, acknowledged references.
    """

    only_against = (
        ("acknowledged", "open-loop", "random-code", "threshold-code"),
        "follows references, and there are none: it is the same as naive here",
    )

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._reader = ReferenceReceiver(knowledge.process, batch.trials)

    def prior(self, first: int = 0) -> Belief:
        """The prior, without references in memory."""
        return self._reader.prior(first)

    def knowing(self, k: int, x: Floats, belief: Belief) -> Belief:
        """It can read every packet with a reference to slot k; its previous reference stays valid."""
        return self._reader.informed(k, x, belief)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Reads with the reference that the header names."""
        return self._reader.step(k, belief, heard)
