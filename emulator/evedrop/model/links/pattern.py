"""Losses in a given pattern: a sequence of outcomes that repeats."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import word_mistakes
from evedrop.model.links.link import LossModel, fates_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes


class Pattern(LossModel):
    """Delivered in slot k where `outcomes`, repeated without end, has a 1 at place k; the same in every trial."""

    parameters = MappingProxyType({"outcomes": "1101"})
    uniforms_per_slot = 1

    def __init__(self, outcomes: str) -> None:
        self._lost = np.frombuffer(outcomes.encode(), np.uint8) == ord("0")

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A word of zeros and ones."""
        return word_mistakes(given, "outcomes")

    @property
    def quality(self) -> float:
        """The fraction of ones."""
        return float(1.0 - self._lost.mean())

    @property
    def memoryless(self) -> bool:
        """True: nothing is random."""
        return True

    def quality_at(self, slots: range) -> Floats:
        """0 or 1."""
        return np.asarray(~self._lost[np.arange(slots.start, slots.stop) % len(self._lost)], np.float64)

    def rate_variance(self, slots: range) -> float:  # noqa: ARG002 - no trial differs from another
        """0, because all trials are equal."""
        return 0.0

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """The outcomes of these slots, the same in every trial."""
        slots, _, trials = uniforms.shape
        places = np.arange(first, first + slots) % len(self._lost)
        return fates_of(np.repeat(self._lost[places][:, None], trials, axis=1))
