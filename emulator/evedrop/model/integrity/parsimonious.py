"""`parsimonious`: a watermark only while the posterior probability of an attack is between two thresholds.

Source: docs/mathematics.md, integrity; Naha, Teixeira, Ahlén and Dey, arXiv 2201.09389.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model.integrity.policy import WatermarkPolicy
from evedrop.model.kernels.elementary import exp
from evedrop.model.numeric.shiryaev import probability_of_change
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags

LOWER, UPPER, RATE = "watch_from", "alarm_from", "attack_rate"
_STEEPEST = 700.0  # a log-likelihood ratio whose exponential is still a number


@final
class Parsimonious(WatermarkPolicy):
    """A watermark while an attack is suspected.

    watch_from: θ₁; alarm_from: θ₂; attack_rate: the prior probability that an attack begins in a slot, if none has begun.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({LOWER: 0.05, UPPER: 0.999, RATE: 1e-3})
    rests = True

    def __init__(self, watch_from: float, alarm_from: float, attack_rate: float) -> None:
        self._lower, self.threshold, self._rate = watch_from, alarm_from, attack_rate

    @classmethod
    def of(cls, given: Mapping[str, float]) -> Parsimonious:
        """The policy with these thresholds."""
        return cls(given[LOWER], given[UPPER], given[RATE])

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Numbers that are not probabilities, and thresholds in the wrong order."""
        found = [
            (name, f"is {given[name]}; expected a number between 0 and 1, both excluded")
            for name in (UPPER, RATE)
            if not 0.0 < given[name] < 1.0
        ]
        if not 0.0 <= given[LOWER] < 1.0:
            found.append((LOWER, f"is {given[LOWER]}; expected a number from 0 to less than 1"))
        if not found and given[LOWER] >= given[UPPER]:
            found.append((LOWER, f"is {given[LOWER]}, and {UPPER} is {given[UPPER]}; expected {LOWER} < {UPPER}"))
        return found

    def step(self, statistic: Floats, llr: Floats) -> Floats:
        """The posterior probability that an attack has begun (Shiryaev)."""
        ratio = exp(np.minimum(np.maximum(llr, -_STEEPEST), _STEEPEST))
        return np.where(self.alarms(statistic), statistic, probability_of_change(statistic, self._rate, ratio, 1.0))

    def marks(self, statistic: Floats) -> Flags:
        """Between the thresholds."""
        flags: Flags = (statistic >= self._lower) & ~self.alarms(statistic)
        return flags

    def expected_delay(self, divergence: float) -> float | None:
        """Not known in closed form."""
        del divergence
        return None

    def false_alarms(self, slots: int) -> float | None:
        """Not known for a given number of slots."""
        del slots
        return None
