"""`jam`: acknowledgements are attacked, as `[acknowledgements]` describes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Self

from pydantic import Field

from evedrop.scenario.events.effects import Jamming
from evedrop.scenario.events.event import Act, EventKind, Surroundings, begun_too_early
from evedrop.scenario.table import Found
from evedrop.scenario.words import as_toml

_JAMMED = "acknowledgements"


class Jam(EventKind):
    """`jam`: the attack lasts only during such events."""

    jam: Annotated[str, Field(examples=[_JAMMED])]

    kind = "jam"
    does = Jamming
    lasts = True

    def acts(self) -> Iterator[Act]:
        """The attack's beginning and end."""
        yield self.begin("acknowledgements are attacked", Jamming(on=True))
        if self.to is not None:
            yield Act(self.to, self.kind, (), "acknowledgements are no longer attacked", Jamming(on=False))

    def compared(self, surroundings: Surroundings) -> Iterator[Found]:
        """Mistakes unless there are acknowledgements and an attack on them."""
        scheme = surroundings.scheme
        if self.jam != _JAMMED:
            yield "jam", f"is {as_toml(self.jam)}; expected {as_toml(_JAMMED)}"
        elif scheme is not None and not scheme.needs_acknowledgements:
            name = surroundings.scheme_name
            yield "jam", f"the scheme {name} has no acknowledgements that could be jammed; remove the event"
        elif surroundings.attack == "none":
            yield "jam", 'no attack is described; expected acknowledgements.attack = "all", or another, as well'

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        yield from begun_too_early(events)
