"""`note`: a line in the list of events."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from evedrop.scenario.events.effects import Nothing
from evedrop.scenario.events.event import Act, EventKind


class Note(EventKind):
    """`note`: nothing happens; the text appears in the list of events."""

    note: Annotated[str, Field(examples=["the door is opened"])]

    kind = "note"
    does = Nothing

    def acts(self) -> Iterator[Act]:
        """The line."""
        yield self.begin(self.note, Nothing())
