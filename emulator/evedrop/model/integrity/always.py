"""`always`: a watermark in every slot, and the CUSUM statistic, G ← max(0, G + llr), with an alarm at G ≥ h.

Source: docs/mathematics.md, integrity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model.integrity.policy import WatermarkPolicy
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags

THRESHOLD = "threshold"


@final
class AlwaysMarked(WatermarkPolicy):
    """A watermark in every slot, and a CUSUM test; threshold: h, in nats."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({THRESHOLD: 8.0})

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    @classmethod
    def of(cls, given: Mapping[str, float]) -> AlwaysMarked:
        """The policy with this threshold."""
        return cls(given[THRESHOLD])

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A threshold that is not above 0."""
        h = given[THRESHOLD]
        if h > 0.0:
            return []
        return [
            (THRESHOLD, f"is {h}; expected a number above 0: false alarms are then e^threshold slots apart, or more")
        ]

    def step(self, statistic: Floats, llr: Floats) -> Floats:
        """CUSUM."""
        return np.where(self.alarms(statistic), statistic, np.maximum(0.0, statistic + llr))

    def marks(self, statistic: Floats) -> Flags:
        """Until the alarm."""
        return ~self.alarms(statistic)

    def expected_delay(self, divergence: float) -> float | None:
        """h/D."""
        return self.threshold / divergence if divergence > 0.0 else None

    def false_alarms(self, slots: int) -> float | None:
        """The number of slots times e^−h: CUSUM is the best of sequential tests that begin in each slot, with this error each."""
        return min(1.0, slots * math.exp(-self.threshold))
