"""The suspicious eavesdropper: distinguishes states from innovations, but not reliably."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import Knowledge, PacketTaker
from evedrop.model.receiver import Flags
from evedrop.model.schedule import Schedule
from evedrop.model.streams import Ahead, Batch, BlockReader


class Suspicious(PacketTaker):
    """Uses a state with probability `use_state` (μ_b), an innovation with `use_innovation` (μ̄_b), by its own coin.

    Source: the paper, suspicious eavesdropper.
    """

    parameters = MappingProxyType({"use_state": 0.8, "use_innovation": 0.2})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._schedule = Schedule(knowledge.keys["schedule"], knowledge.mu_d, batch)
        self._use_state, self._use_innovation = self.use_probabilities(knowledge.parameters)
        self._coins = BlockReader(knowledge.keys["coin"], batch, 1)
        self._used = Ahead(self._coins.ahead, self._tossed)

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG003 - alike for all
        """The schedule, which it tests imperfectly, and its own coin."""
        return "schedule", "coin"

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:
        """μ_b and μ̄_b."""
        return parameters["use_state"], parameters["use_innovation"]

    def uses_block(self, slots: range) -> Flags:
        """True where a slot's coin falls below the probability for the packet's type."""
        return self._used.of(slots)

    def _tossed(self, slots: range) -> Flags:
        coins = self._coins.uniforms(slots)[:, 0, :]
        used: Flags = coins < np.where(self._schedule.block(slots), self._use_innovation, self._use_state)
        return used
