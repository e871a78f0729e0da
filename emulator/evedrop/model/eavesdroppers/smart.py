"""The smart eavesdropper: knows the schedule and never takes an innovation for the state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketTaker
from evedrop.model.receiver import Flags
from evedrop.model.schedule import Schedule
from evedrop.model.streams import Batch


class Smart(PacketTaker):
    """b_k = 1 − ν_k; it knows the schedule. Its believed covariance is the actual one.

    Source: the paper, smart eavesdropper.
    """

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._schedule = Schedule(knowledge.keys["schedule"], knowledge.mu_d, batch)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003 - alike for all
        """The schedule."""
        return ("schedule",)

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Every state, no innovation."""
        return 1.0, 0.0

    def uses_block(self, slots: range) -> Flags | None:
        """Where the packet is the state."""
        return ~self._schedule.block(slots)
