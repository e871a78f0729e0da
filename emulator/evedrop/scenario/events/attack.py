"""The base class of events during which something is attacked, as a table of the scenario describes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import ClassVar, Self

from evedrop.scenario.events.effects import Jamming, Spoofing
from evedrop.scenario.events.event import Act, EventKind, Surroundings, begun_too_early
from evedrop.scenario.table import Found
from evedrop.scenario.words import as_toml


class Attack(EventKind):
    """The attack lasts only during such events; their main entry is the word for what is attacked."""

    attacked: ClassVar[str]
    """The only value of the main entry."""
    does: ClassVar[type[Jamming] | type[Spoofing]]
    lasts = True

    @abstractmethod
    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless the scenario describes such an attack."""

    def acts(self) -> Iterator[Act]:
        """The attack's beginning and end."""
        yield self.begin(f"{self.attacked} are attacked", self.does(on=True))
        if self.to is not None:
            yield Act(self.to, self.kind, (), f"{self.attacked} are no longer attacked", self.does(on=False))

    def compared(self, surroundings: Surroundings) -> Iterator[Found]:
        """A mistake for another value of the main entry, and those of `undescribed`."""
        given = getattr(self, self.kind)
        if given != self.attacked:
            yield self.kind, f"is {as_toml(given)}; expected {as_toml(self.attacked)}"
        else:
            yield from ((self.kind, sentence) for sentence in self.undescribed(surroundings))

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        yield from begun_too_early(events)
