"""`cut` and `heal`: nothing gets through a link, until it is healed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.scenario.events.effects import LinkCut, LinkHealed
from evedrop.scenario.events.event import Act, EventKind, Fault, Names, spoken


def cut_off(event: EventKind) -> Iterator[Act]:
    """The acts of an event that cuts off its receivers, and heals their links when it ends."""
    names = spoken(event.names)
    yield Act(event.first, Cut.kind, event.names, f"{Cut.kind} {names}", LinkCut())
    if event.to is not None:
        yield Act(event.to, Heal.kind, event.names, f"{Heal.kind} {names}", LinkHealed())


class Cut(EventKind):
    """`cut`: packets that are sent over these links are lost."""

    cut: Annotated[Names, Field(examples=["legitimate"])]

    kind = "cut"
    does = LinkCut
    lasts = True
    names_in = "cut"
    by_operator = True
    fault = Fault(2)

    def acts(self) -> Iterator[Act]:
        """The cut, and the heal."""
        return cut_off(self)


class Heal(EventKind):
    """`heal`: these links are no longer cut."""

    heal: Annotated[Names, Field(examples=["legitimate"])]

    kind = "heal"
    does = LinkHealed
    names_in = "heal"
    by_operator = True

    def acts(self) -> Iterator[Act]:
        """The heal."""
        yield self.begin(f"heal {spoken(self.names)}", LinkHealed())
