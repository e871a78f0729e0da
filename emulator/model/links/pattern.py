"""Losses by rote: a given sequence of outcomes, over and over."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from emulator.model.links.link import LossModel, fates_of
from emulator.model.process import Floats
from emulator.model.receiver import Codes


class Pattern(LossModel):
    """Delivered in slot k where `outcomes`, repeated without end, has a 1 at place k; the same in every trial."""

    parameters = MappingProxyType({"outcomes": "1101"})
    uniforms_per_slot = 1

    def __init__(self, outcomes: str) -> None:
        self._lost = np.frombuffer(outcomes.encode(), np.uint8) == ord("0")

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A word of zeros and ones."""
        outcomes = given.get("outcomes", "1")
        if not isinstance(outcomes, str) or not outcomes or set(outcomes) - {"0", "1"}:
            return [("outcomes", f'is {outcomes!r}; expected a word of 0 (lost) and 1 (delivered), such as "1101"')]
        return []

    @property
    def quality(self) -> float:
        """The fraction of ones."""
        return float(1.0 - self._lost.mean())

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """By the slot alone."""
        slots, _, trials = uniforms.shape
        places = np.arange(first, first + slots) % len(self._lost)
        return fates_of(np.repeat(self._lost[places][:, None], trials, axis=1))
