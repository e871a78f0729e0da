"""The base class of attacks on the sensor's measurements: other numbers take their place in some slots.

Source: docs/mathematics.md, integrity.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self

from evedrop.model.integrity.loop import Source, WatermarkedLoop
from evedrop.model.process import Floats
from evedrop.model.streams import Batch


class MeasurementFeed(ABC):
    """What a batch's sensors report, slot by slot, in order from slot 0 on."""

    @abstractmethod
    def take(self, k: int, y: Floats, on: bool) -> Floats:
        """The measurements that the filter gets in slot k, (p, R), from those that were made, y (p, R); on: during the attack."""


class SensorAttack(ABC):
    """An attack on measurements. Each file defines one, registered by its name in a scenario.

    `parameters` are its entries in the scenario, each with an example.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[tuple[str, ...]] = ()
    """Those of `parameters` that may be left out."""

    @classmethod
    @abstractmethod
    def objections(cls, given: Mapping[str, Any], loop: WatermarkedLoop, first: int) -> list[tuple[str, str]]:
        """Reasons why it is impossible: (entry, value found and expected). first: the slot in which it begins."""

    @classmethod
    @abstractmethod
    def of(cls, given: Mapping[str, Any], loop: WatermarkedLoop, watermark: Floats) -> Self:
        """The attack on a loop whose inputs have a watermark of this covariance, (m, m); given: its entries."""

    @abstractmethod
    def source(self, loop: WatermarkedLoop, watermark: Floats) -> Source:
        """The distribution of the measurements that it makes the sensor report."""

    @property
    @abstractmethod
    def plain(self) -> dict[str, Any]:
        """Its data as numbers and lists of numbers, from which `read` makes it."""

    @classmethod
    @abstractmethod
    def read(cls, plain: Mapping[str, Any]) -> Self:
        """The attack with this data."""

    @abstractmethod
    def feed(self, key: bytes, batch: Batch) -> MeasurementFeed:
        """What it makes the sensors of a batch report; key: of the stream `spoofing`."""
