"""`spoof`: the sensor's measurements are attacked, as `[integrity]` describes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Self

from pydantic import Field

from evedrop.scenario.events.effects import Spoofing
from evedrop.scenario.events.event import Act, EventKind, Surroundings, begun_too_early
from evedrop.scenario.table import Found
from evedrop.scenario.words import as_toml

_SPOOFED = "measurements"


class Spoof(EventKind):
    """`spoof`: the attack lasts only during such events."""

    spoof: Annotated[str, Field(examples=[_SPOOFED])]

    kind = "spoof"
    does = Spoofing
    lasts = True

    def acts(self) -> Iterator[Act]:
        """The attack's beginning and end."""
        yield self.begin("measurements are attacked", Spoofing(on=True))
        if self.to is not None:
            yield Act(self.to, self.kind, (), "measurements are no longer attacked", Spoofing(on=False))

    def compared(self, surroundings: Surroundings) -> Iterator[Found]:
        """Mistakes unless an attack on measurements is described."""
        if self.spoof != _SPOOFED:
            yield "spoof", f"is {as_toml(self.spoof)}; expected {as_toml(_SPOOFED)}"
        elif not surroundings.monitored:
            yield "spoof", "no attack is described; expected a table [integrity] with an attack as well"

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        yield from begun_too_early(events)
