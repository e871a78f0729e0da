"""Watermark policies: from log-likelihood ratios to a statistic, an alarm, and whether to add a watermark.

`always`: a watermark in every slot, and the CUSUM statistic, G ← max(0, G + llr), with an alarm at G ≥ h. `parsimonious`: a
watermark only while the posterior probability of an attack is between two thresholds.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self, final

import numpy as np

from evedrop.model.detection import probability_of_change
from evedrop.model.kernels.elementary import exp
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


class WatermarkPolicy(ABC):
    """A policy. Each file defines one, registered by its name in a scenario.

    Its statistic stays as it is after an alarm, and the watermark ends with the alarm.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Its entries in the scenario, each with an example."""
    rests: ClassVar[bool] = False
    """Whether there is no watermark as long as nothing points to an attack."""
    threshold: float
    """There is an alarm where the statistic is at least this."""

    @classmethod
    @abstractmethod
    def of(cls, given: Mapping[str, float]) -> Self:
        """The policy with these parameters."""

    @classmethod
    @abstractmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in parameters, all of them given as numbers: (entry, value found and expected)."""

    @abstractmethod
    def step(self, statistic: Floats, llr: Floats) -> Floats:
        """The statistic after a slot, (R,), from the one before, 0 at first, and the slot's log-likelihood ratio, (R,)."""

    @abstractmethod
    def marks(self, statistic: Floats) -> Flags:
        """Whether the next input gets a watermark, (R,)."""

    @abstractmethod
    def expected_delay(self, divergence: float) -> float | None:
        """About the mean number of slots until an attack is detected; divergence: D, per slot; None if no formula is known."""

    @abstractmethod
    def false_alarms(self, slots: int) -> float | None:
        """A bound on the probability of a false alarm in this many slots; None if none is known."""

    def alarms(self, statistic: Floats) -> Flags:
        """Whether the alarm is raised, (…)."""
        return statistic >= self.threshold


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
        mistakes = [
            (name, f"is {given[name]}; expected a number between 0 and 1, both excluded")
            for name in (UPPER, RATE)
            if not 0.0 < given[name] < 1.0
        ]
        if not 0.0 <= given[LOWER] < 1.0:
            mistakes.append((LOWER, f"is {given[LOWER]}; expected a number from 0 to less than 1"))
        if not mistakes and given[LOWER] >= given[UPPER]:
            mistakes.append((LOWER, f"is {given[LOWER]}, and {UPPER} is {given[UPPER]}; expected {LOWER} < {UPPER}"))
        return mistakes

    def step(self, statistic: Floats, llr: Floats) -> Floats:
        """The posterior probability that an attack has begun (Shiryaev)."""
        ratio = exp(np.minimum(np.maximum(llr, -_STEEPEST), _STEEPEST))
        return np.where(self.alarms(statistic), statistic, probability_of_change(statistic, self._rate, ratio, 1.0))

    def marks(self, statistic: Floats) -> Flags:
        """Between the thresholds."""
        return (statistic >= self._lower) & ~self.alarms(statistic)

    def expected_delay(self, divergence: float) -> float | None:
        """Not known in closed form."""
        del divergence
        return None

    def false_alarms(self, slots: int) -> float | None:
        """Not known for a given number of slots."""
        del slots
        return None
