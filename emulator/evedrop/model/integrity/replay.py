"""`replay`: the sensor reports again what it measured in the slots before the attack, over and over.

Source: docs/mathematics.md, integrity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from evedrop.model.integrity.attack import MeasurementFeed, SensorAttack
from evedrop.model.integrity.loop import Source, WatermarkedLoop
from evedrop.model.process import Floats
from evedrop.model.streams import Batch

RECORDED = "recorded"


@final
@dataclass(frozen=True)
class Replay(SensorAttack):
    """The last measurements before the attack, in a loop. Its distribution is that of measurements when nobody attacks."""

    recorded: int
    """The number of slots that were recorded."""

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({RECORDED: 100})

    @classmethod
    def objections(cls, given: Mapping[str, Any], loop: WatermarkedLoop, first: int) -> list[tuple[str, str]]:
        """A recording that would begin before slot 0."""
        del loop
        recorded = given[RECORDED]
        if recorded <= first:
            return []
        return [
            (
                RECORDED,
                f"is {recorded}, but the attack begins in slot {first}; expected at most as many slots as pass before it",
            )
        ]

    @classmethod
    def of(cls, given: Mapping[str, Any], loop: WatermarkedLoop, watermark: Floats) -> Replay:
        """The attack with this recording."""
        del loop, watermark
        return cls(given[RECORDED])

    def source(self, loop: WatermarkedLoop, watermark: Floats) -> Source:
        """The loop's own measurements, of a time that has passed."""
        return loop.nominal(watermark)

    @property
    def plain(self) -> dict[str, Any]:
        """The number of slots."""
        return {RECORDED: self.recorded}

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Replay:
        """The attack with this data."""
        return cls(plain[RECORDED])

    def feed(self, key: bytes, batch: Batch) -> MeasurementFeed:
        """The recording of every trial."""
        del key, batch
        return _Recording(self.recorded)


@final
class _Recording(MeasurementFeed):
    """The slot k of the attack repeats slot k − recorded, so both are at the same place, k modulo `recorded`."""

    def __init__(self, recorded: int) -> None:
        self._recorded = recorded
        self._kept: Floats | None = None

    def take(self, k: int, y: Floats, on: bool) -> Floats:
        if self._kept is None:
            self._kept = np.zeros((self._recorded, *y.shape))
        if not on:
            self._kept[k % self._recorded] = y
        again: Floats = self._kept[k % self._recorded]
        return again
