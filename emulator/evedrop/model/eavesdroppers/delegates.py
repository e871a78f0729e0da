"""Eavesdroppers with an additional ability that otherwise read packets as another strategy does.

Colluding eavesdroppers have several links and one reader, which hears what any of the links delivers. To the replay-informed
eavesdropper one true state is betrayed, whatever its link does in that slot.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from evedrop.model.checks import LAST_SLOT, whole_number_mistakes
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, Knowledge
from evedrop.model.eavesdroppers.readers import READERS
from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Beliefs, Codes, Flags, Reception
from evedrop.model.streams import Batch
from evedrop.model.theory.covariances import OutcomesAt


class Delegate(Eavesdropper):
    """Reads as `reads_as` does, with the keys that that strategy needs."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({"reads_as": "smart"})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self.reader = READERS.imported(knowledge.parameters["reads_as"])(knowledge, batch)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:
        """The reader's streams."""
        return READERS[parameters["reads_as"]].streams(parameters)

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """The reader's outcomes."""
        return READERS[parameters["reads_as"]].outcomes(parameters, mu_d)

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:
        """Whether the reader follows γ."""
        return READERS[parameters["reads_as"]].follows_gamma(parameters)

    def prior(self, first: int = 0) -> Belief:
        """The reader's prior."""
        return self.reader.prior(first)

    def learned(self, belief: Belief) -> Mapping[str, Floats]:
        """What the reader has learned."""
        return self.reader.learned(belief)

    def act(self, k: int, gamma: Flags) -> Codes:
        """The reader's action."""
        return self.reader.act(k, gamma)

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """The reader's belief."""
        return self.reader.step(k, belief, heard)

    def follow(self, slots: range, belief: Belief, gamma: Flags, z: Floats) -> tuple[Beliefs, Belief]:
        """The reader's beliefs."""
        return self.reader.follow(slots, belief, gamma, z)


class Colluding(Delegate):
    """Reads as the strategy `reads_as` does.

    Source: docs/mathematics/eavesdroppers.md, further eavesdroppers.
    """

    pools_links = True


class ReplayInformed(Delegate):
    """Learns x_j in the slot j = `learns_at` from `Reception.truth`; otherwise reads as the strategy `reads_as` does.

    Source: docs/mathematics/eavesdroppers.md, further eavesdroppers.
    """

    parameters = MappingProxyType({"learns_at": 40, "reads_as": "smart"})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._learns_at = int(knowledge.parameters["learns_at"])

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A mistake if `learns_at` is not the number of a slot."""
        return whole_number_mistakes(given, "learns_at", 0, LAST_SLOT)

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
