"""Eavesdroppers that use a packet as the state, or ignore it, by a fixed rule.

The constant eavesdropper does not listen. The naive one takes every packet for the state. The smart one knows the schedule and
never takes an innovation for the state; the suspicious one distinguishes states from innovations, but not reliably. The
selective one uses packets sent unencrypted, and ignores those that are encrypted according to the header.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model import update
from evedrop.model.checks import probability_mistakes
from evedrop.model.eavesdroppers.eavesdropper import Knowledge, KnowsSchedule, PacketReader, PacketTaker
from evedrop.model.receiver import Action, Belief, Flags, Reception
from evedrop.model.streams import Ahead, Batch, BlockReader


class ConstantEstimate(PacketTaker):
    """b_k = 0 always: x̂ = 0 and P = Σ_k. An eavesdropper with a larger error would do better not to listen.

    Source: docs/mathematics/eavesdroppers.md, eavesdroppers.
    """

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Never."""
        return 0.0, 0.0

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Never."""
        return np.zeros(self.trials, np.bool_)


class Naive(PacketTaker):
    """b_k = 1 always; it needs no knowledge.

    Source: the paper, naive eavesdropper.
    """

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Certain for both types."""
        return 1.0, 1.0

    def uses_block(self, slots: range) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Always."""
        return None


class Smart(KnowsSchedule, PacketTaker):
    """b_k = 1 − ν_k; it knows the schedule. Its reported covariance is the actual one.

    Source: the paper, smart eavesdropper.
    """

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Every state, no innovation."""
        return 1.0, 0.0

    def uses_block(self, slots: range) -> Flags | None:
        """Where the packet is the state."""
        return ~self._schedule.block(slots)


class Suspicious(KnowsSchedule, PacketTaker):
    """Uses a state with probability `use_state` (μ_b), an innovation with `use_innovation` (μ̄_b), by its own coin.

    Source: the paper, suspicious eavesdropper.
    """

    parameters = MappingProxyType({"use_state": 0.8, "use_innovation": 0.2})

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge, batch)
        self._use_state, self._use_innovation = self.use_probabilities(knowledge.parameters)
        self._coins = BlockReader(knowledge.keys["coin"], batch, 1)
        self._used = Ahead(self._coins.ahead, self._tossed)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in the two probabilities."""
        return probability_mistakes(given, "use_state", "use_innovation")

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
        return coins < np.where(self._schedule.block(slots), self._use_innovation, self._use_state)


class Selective(PacketReader):
    """b_k = 1 where the header is 0, or missing; it needs no knowledge.

    Intended only for the schemes `encrypted-schedule`, against which it is optimal, and `quantised-schedule`, whose quantiser
    it takes for exact.

    Source: docs/mathematics/schemes.md, schedules by holding time and quantised packets.
    """

    only_against = (
        ("encrypted-schedule", "quantised-schedule"),
        "reads a header that says which packets are encrypted, and there is none: it is the same as naive here",
    )

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """A x̂ and A P Aᵀ + Q, or z and 0 where a packet is unencrypted."""
        # The codes 0 and 1 of `Action` are γ itself: the state where a packet arrives.
        action = heard.gamma.astype(np.uint8)
        if heard.header is not None:
            action = np.where(heard.gamma & (heard.header[0] != 0), np.uint8(Action.DISCARDED), action)
        return update.belief(self.process, k, belief, action, heard.z)
