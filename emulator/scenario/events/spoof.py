"""`spoof`: the sensor's measurements are attacked, as the table of an application describes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Self

from pydantic import Field

from evedrop.scenario.application import APPLICATIONS, applications_in
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
            able = [f"[{name}]" for name, one in applications_in(APPLICATIONS.names).items() if one.has_monitor]
            yield "spoof", f"no attack is described; expected a table {' or '.join(able)} with an attack as well"

    @classmethod
    def in_turn(cls, events: Sequence[tuple[int, Self]]) -> Iterator[str]:
        """Mistakes where an attack begins before the previous one has ended."""
        yield from begun_too_early(events)
