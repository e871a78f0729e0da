"""`partition`: receivers are cut off together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.scenario.events.cut import cut_off
from evedrop.scenario.events.effects import LinkCut
from evedrop.scenario.events.event import Act, EventKind, Fault


class Partition(EventKind):
    """`partition`: a list of receivers, whose links are all cut."""

    partition: Annotated[list[str], Field(examples=[["legitimate", "smart"]])]

    kind = "partition"
    does = LinkCut
    lasts = True
    names_in = "partition"
    fault = Fault(4, together=True)

    def acts(self) -> Iterator[Act]:
        """The cut of each link, and the heal."""
        return cut_off(self)
