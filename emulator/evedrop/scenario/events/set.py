"""`set`: entries of a link, or of several, change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from evedrop.scenario.events.effects import LinkSettings
from evedrop.scenario.events.event import Act, EventKind, Fault, Names, spoken
from evedrop.scenario.table import refuse
from evedrop.scenario.words import as_toml


def _some(changes: dict[str, Any]) -> dict[str, Any]:
    if not changes:
        refuse([("", "is empty; expected what changes, such as set = { quality = 0.2 }")])
    return changes


class Set(EventKind):
    """`link` and `set`: entries of the links change. At the end, all changes that events have made to them are undone."""

    link: Annotated[Names, Field(description="the link that is changed", examples=["legitimate"])]
    set: Annotated[dict[str, Any], AfterValidator(_some), Field(examples=[{"quality": 0.2}])]

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
        changes = ", ".join(f"{entry} = {as_toml(value)}" for entry, value in self.set.items())
        yield self.begin(f"{link}: {changes}", LinkSettings(self.set))
        if self.to is not None:
            yield Act(self.to, self.kind, self.names, f"{link}: as at first", LinkSettings(None))
