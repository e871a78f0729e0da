"""The events during which something is attacked: `jam` acknowledgements, `spoof` the sensor's measurements.

A table describes the attack: `[acknowledgements]`, or that of an application.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, ClassVar, Self

from pydantic import Field

from evedrop.scenario.application import APPLICATIONS, applications_in
from evedrop.scenario.events.event import Act, EventKind, Jamming, Spoofing, Surroundings
from evedrop.scenario.table import Mistake
from evedrop.scenario.words import as_toml


class Attack(EventKind):
    """The attack lasts only during such events; their main entry is the word for what is attacked."""

    does: ClassVar[type[Jamming] | type[Spoofing]]
    """Its `attacked` is the only value of the main entry."""
    lasts = True

    @abstractmethod
    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless the scenario describes such an attack."""

    def acts(self) -> Iterator[Act]:
        """The attack's beginning and end."""
        yield self.begin(f"{self.does.attacked} are attacked", self.does(on=True))
        if self.to is not None:
            yield Act(self.to, self.kind, (), f"{self.does.attacked} are no longer attacked", self.does(on=False))

    def compared(self, surroundings: Surroundings) -> Iterator[Mistake]:
        """A mistake for another value of the main entry, and those of `undescribed`."""
        given = getattr(self, self.kind)
        if given != self.does.attacked:
            yield self.kind, f"is {as_toml(given)}; expected {as_toml(self.does.attacked)}"
        else:
            yield from ((self.kind, sentence) for sentence in self.undescribed(surroundings))

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        in_order = sorted(events, key=lambda numbered: numbered[1].first)
        for (_, before), (i, event) in pairwise(in_order):
            if before.to is None or before.to > event.first:
                lasting = "while another one lasts; expected that one to end first"
                yield f"event.{i}.{event.kind}: begins in slot {event.first}, {lasting}"


class Jam(Attack):
    """`jam`: the attack lasts only during such events."""

    jam: Annotated[str, Field(examples=["acknowledgements"])]
    """`"acknowledgements"`: the attack that `[acknowledgements]` describes lasts only during such events."""

    kind = "jam"
    does = Jamming

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless there are acknowledgements and an attack on them."""
        scheme = surroundings.scheme
        if not scheme.needs_acknowledgements:
            name = surroundings.scheme_name
            yield f"the scheme {name} has no acknowledgements that could be jammed; remove the event"
        elif surroundings.attack == "none":
            yield 'no attack is described; expected acknowledgements.attack = "all", or another, as well'


class Spoof(Attack):
    """`spoof`: the attack lasts only during such events."""

    spoof: Annotated[str, Field(examples=["measurements"])]
    """`"measurements"`: the attack that `[integrity]` describes lasts only during such events."""

    kind = "spoof"
    does = Spoofing

    def undescribed(self, surroundings: Surroundings) -> Iterator[str]:
        """Mistakes unless an attack on measurements is described."""
        if not surroundings.monitored:
            loaded = applications_in(APPLICATIONS.names).items()
            able = [f"[{name}]" for name, application in loaded if application.has_monitor]
            yield f"no attack is described; expected a table {' or '.join(able)} with an attack as well"
