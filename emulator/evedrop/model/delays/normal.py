"""Normally distributed delays, as in netem."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.delays.delay import DelayModel, length_mistakes
from evedrop.model.process import Floats


class Normal(DelayModel):
    """Delays max(0, mean + standard_deviation · N(0, 1)), independent, so packets may overtake each other.

    Source: docs/mathematics.md, late packets.
    """

    parameters = MappingProxyType({"mean": 2.0, "standard_deviation": 0.5})
    lengths = ("mean", "standard_deviation")
    normal = True

    def __init__(self, mean: float, standard_deviation: float) -> None:
        self._mean, self._standard_deviation = float(mean), float(standard_deviation)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Neither length is negative."""
        return length_mistakes(given, "mean", "standard_deviation")

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """Each from a standard normal number."""
        scattered: Floats = self._mean + self._standard_deviation * numbers
        return np.maximum(0.0, scattered)

    def arrived(self, lag: int) -> float | None:
        """Φ((lag + 1 − mean) / standard_deviation)."""
        if self._standard_deviation == 0.0:
            return float(self._mean < lag + 1)
        return 0.5 * math.erfc(-(lag + 1 - self._mean) / (self._standard_deviation * math.sqrt(2.0)))
