"""The base class of watermark policies: from log-likelihood ratios to a statistic, an alarm, and whether to add a watermark.

Source: docs/mathematics.md, integrity.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self

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
        flags: Flags = statistic >= self.threshold
        return flags
