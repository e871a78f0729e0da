"""The events that change links: `set` changes entries, `cut` and `partition` let nothing through, and `heal` ends a cut.

`partition` cuts off several receivers together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from evedrop.scenario.events.event import Act, EventKind, Fault, LinkCut, LinkHealed, LinkSettings, Names, spoken
from evedrop.scenario.table import refuse
from evedrop.scenario.words import as_toml


def _some(changes: dict[str, Any]) -> dict[str, Any]:
    if not changes:
        refuse([("", "is empty; expected what changes, such as set = { quality = 0.2 }")])
    return changes


class Set(EventKind):
    """`link` and `set`: entries of the links change. At the end, all changes that events have made to them are undone."""

    link: Annotated[Names, Field(description="the link that is changed", examples=["legitimate"])]
    """The link that `set` changes, or a list of links."""
    set: Annotated[dict[str, Any], AfterValidator(_some), Field(examples=[{"quality": 0.2}])]
    """The changed entries of the link. With `to`, all changes by events are undone at the end."""

    kind = "set"
    does = LinkSettings
    lasts = True
    names_in = "link"
    by_operator = True
    fault = Fault(3, needs={"set": "what changes"})
    alone: ClassVar[Mapping[str, str]] = {
        "link": "is given without set; expected what changes, such as set = { quality = 0.2 }"
    }

    def acts(self) -> Iterator[Act]:
        """The changes, and their end."""
        link = f"link {spoken(self.names)}"
        in_order = sorted(self.set.items(), key=lambda entry: isinstance(entry[1], Mapping))  # as a TOML file has them
        changes = ", ".join(f"{entry} = {as_toml(value)}" for entry, value in in_order)
        yield self.begin(f"{link}: {changes}", LinkSettings(self.set))
        if self.to is not None:
            yield Act(self.to, self.kind, self.names, f"{link}: as at first", LinkSettings(None))


def cut_off(event: EventKind) -> Iterator[Act]:
    """The acts of an event that cuts off its receivers, and heals their links when it ends."""
    names = spoken(event.names)
    yield Act(event.first, Cut.kind, event.names, f"{Cut.kind} {names}", LinkCut())
    if event.to is not None:
        yield Act(event.to, Heal.kind, event.names, f"{Heal.kind} {names}", LinkHealed())


class Cut(EventKind):
    """`cut`: packets that are sent over these links are lost."""

    cut: Annotated[Names, Field(examples=["legitimate"])]
    """Cuts a link, or a list of links: packets sent meanwhile are lost; packets under way arrive."""

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
    """Ends the cut of a link, or of a list of links."""

    kind = "heal"
    does = LinkHealed
    names_in = "heal"
    by_operator = True

    def acts(self) -> Iterator[Act]:
        """The heal."""
        yield self.begin(f"heal {spoken(self.names)}", LinkHealed())


class Partition(EventKind):
    """`partition`: a list of receivers, whose links are all cut."""

    partition: Annotated[list[str], Field(examples=[["legitimate", "smart"]])]
    """Cuts a list of receivers off together."""

    kind = "partition"
    does = LinkCut
    lasts = True
    names_in = "partition"
    fault = Fault(4, together=True)

    def acts(self) -> Iterator[Act]:
        """The cut of each link, and the heal."""
        return cut_off(self)
