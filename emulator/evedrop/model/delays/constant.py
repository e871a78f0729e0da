"""The same delay for every packet."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.delays.delay import DelayModel, length_mistakes
from evedrop.model.process import Floats


class ConstantDelay(DelayModel):
    """A delay of `value`.

    Source: docs/mathematics.md, late packets.
    """

    parameters = MappingProxyType({"value": 2.0})
    lengths = ("value",)

    def __init__(self, value: float) -> None:
        self._value = float(value)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The length is not negative."""
        return length_mistakes(given, "value")

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """The constant."""
        return np.full(numbers.shape, self._value)

    def arrived(self, lag: int) -> float | None:
        """1 if the delay is shorter, otherwise 0."""
        return float(self._value < lag + 1)
