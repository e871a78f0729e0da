"""The naive eavesdropper: takes every packet for the state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evedrop.model.eavesdroppers.eavesdropper import PacketTaker
from evedrop.model.receiver import Flags


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
