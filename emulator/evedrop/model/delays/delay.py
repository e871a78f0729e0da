"""The base class of delay models: from random numbers to the delay of every packet, in slots."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from evedrop.model.checks import number_mistakes
from evedrop.model.process import Floats

LONGEST = 1e6
"""The longest delay in slots; longer delays are cut to it, since no receiver waits that long."""


def length_mistakes(given: Mapping[str, Any], *names: str) -> list[tuple[str, str]]:
    """A mistake for every one of the names that is given and is not a length of time."""
    return [mistake for name in names for mistake in number_mistakes(given, name, 0.0, LONGEST)]


class DelayModel(ABC):
    """Decides delays from random numbers, for all trials at once, slot by slot.

    Each file of this folder defines one model, whose name in a scenario is the file's name. `parameters` are the entries
    that the scenario gives it, each with an example; lengths of time are in slots.
    """

    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    optional: ClassVar[frozenset[str]] = frozenset()
    recorded: ClassVar[str | None] = None
    """The parameter that gets the contents of the recording `file`; None if there is none. Only for built-in models."""
    lengths: ClassVar[tuple[str, ...]] = ()
    """The parameters that are lengths of time, and may therefore be given in seconds."""
    normal: ClassVar[bool] = False
    """Whether it needs standard normal numbers; otherwise it gets uniform ones."""

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Mistakes in parameters, all of them known but some perhaps missing: (entry, value found and expected)."""
        del given
        return []

    @abstractmethod
    def delays(self, first: int, numbers: Floats) -> Floats:
        """Delay of each packet of the next slots in slots, (slots, R), at least 0, from one number each, (slots, R)."""

    @abstractmethod
    def arrived(self, lag: int) -> float | None:
        """Probability that a delay is below lag + 1 slots, so that the packet has arrived; None if slots differ."""
