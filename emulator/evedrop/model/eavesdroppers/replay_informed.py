"""The replay-informed eavesdropper: one true state is betrayed to it, whatever its link does in that slot."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from evedrop.model.eavesdroppers.delegate import Delegate
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.receiver import Belief, Reception
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import OutcomesAt


class ReplayInformed(Delegate):
    """Learns x_j in the slot j = `learns_at` from `Reception.truth`; otherwise reads as the strategy `reads_as` does.

    Source: docs/mathematics.md, further eavesdroppers.
    """

    parameters = MappingProxyType({"learns_at": 40, "reads_as": "smart"})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._learns_at = int(knowledge.parameters["learns_at"])

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:  # noqa: ARG003 - alike for all
        """No closed form."""
        return None

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:  # noqa: ARG003 - alike for all readers
        """False, because of one slot."""
        return False

    @classmethod
    def betrayed(cls, parameters: Mapping[str, Any]) -> int | None:
        """The slot j."""
        return int(parameters["learns_at"])

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As the reader; after slot j only the state x_j. Raises ValueError if that state was not given to it."""
        belief = self.reader.step(k, belief, heard._replace(truth=None))
        if k != self._learns_at:
            return belief
        if heard.truth is None:
            raise ValueError(f"slot {k}: the state was to be betrayed in this slot, and was not")
        return self.reader.knowing(k, heard.truth, belief)
