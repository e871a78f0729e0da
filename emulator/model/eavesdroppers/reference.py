"""The eavesdropper of references: reads state-secrecy codes with the references it heard itself."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from emulator.model.receiver import Belief, Codes, Flags, Heard
from emulator.model.reference import ReferenceReceiver
from emulator.streams import Batch


class Reference(Eavesdropper):
    """Follows the headers as the legitimate estimator does; it is given nothing, for the code has no secret.

    Meant for the scheme `acknowledged` alone, against which it is the best there is for unstable A.

    Source: docs/mathematics.md, acknowledged references.
    """

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._reader = ReferenceReceiver(knowledge.process, batch.trials)

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, float]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Of a state, certain; innovations are not sent to it."""
        return 1.0, 0.0

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - the header decides
        """All that it can decode."""
        return None

    def prior(self) -> Belief:
        """With an empty memory of references."""
        return self._reader.prior()

    def act(self, k: int, gamma: Flags) -> Codes:
        """Not to be told without the packet."""
        return self._reader.act(k, gamma)

    def step(self, k: int, belief: Belief, heard: Heard) -> Belief:
        """By the reference that the header names."""
        return self._reader.step(k, belief, heard)
