"""What a delay model is: from random numbers to how long every packet takes, in slots."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from evedrop.model.process import Floats

LONGEST = 1e6
"""Slots: a longer delay is cut to this, which no receiver waits for."""


class DelayModel(ABC):
    """Decides delays from random numbers, for all trials at once, slot after slot.

    A file of this folder holds one model, and its name in a scenario is that of the file. `parameters` are the entries
    that the scenario gives it, each with an example; lengths of time are in slots.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[frozenset[str]] = frozenset()
    lengths: ClassVar[tuple[str, ...]] = ()
    """The parameters that are lengths of time, and so may be given in seconds."""
    normal: ClassVar[bool] = False
    """Whether it is given standard normal numbers; else uniform ones."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What is wrong with parameters that are all known, if not all there: (entry, what was found and expected)."""
        del given
        return []

    @abstractmethod
    def delays(self, first: int, numbers: Floats) -> Floats:
        """Delay of each packet of the next slots in slots, (slots, R) of at least 0, from one number each, (slots, R)."""

    @abstractmethod
    def arrived(self, lag: int) -> float | None:
        """Probability that a delay is below lag + 1 slots, so that the packet is there by then; None if slots differ."""
