"""`[[event]]`: what happens during a run, and in which slot.

Source: docs/scenario.md, events.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from evedrop.scenario.table import Found, Table
from evedrop.scenario.words import listed
from evedrop.streams import MOST_SLOTS

LASTING = ("set", "cut", "partition", "kill", "pause", "jam")
"""The kinds that can last `from` one slot `to` another."""
KINDS = (*LASTING, "heal", "restart", "resume", "note")
"""All kinds; an event has exactly one of them."""

Names = str | list[str]
Slot = Annotated[int, Field(strict=True, ge=0, le=MOST_SLOTS, examples=[400])]


class EventTable(Table):
    """`[[event]]`: one thing that happens `at` a slot, or lasts `from` one slot `to` another."""

    at: Slot | None = None
    start: Annotated[Slot | None, Field(alias="from")] = None
    to: Slot | None = None
    link: Annotated[Names | None, Field(examples=["legitimate"])] = None
    set: Annotated[dict[str, Any] | None, Field(examples=[{"quality": 0.2}])] = None
    cut: Annotated[Names | None, Field(examples=["legitimate"])] = None
    heal: Annotated[Names | None, Field(examples=["legitimate"])] = None
    partition: Annotated[list[str] | None, Field(examples=[["legitimate", "smart"]])] = None
    jam: Annotated[str | None, Field(examples=["acknowledgements"])] = None
    kill: Annotated[str | None, Field(examples=["legitimate"])] = None
    restart: Annotated[str | None, Field(examples=["legitimate"])] = None
    state: Annotated[Literal["prior", "last"] | None, Field(examples=["last"])] = None
    pause: Annotated[str | None, Field(examples=["legitimate"])] = None
    resume: Annotated[str | None, Field(examples=["legitimate"])] = None
    note: Annotated[str | None, Field(examples=["the door is opened"])] = None

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """Mistakes unless exactly one thing happens, at a time that is stated in one way."""
        return [*_what_mistakes(table), *_when_mistakes(table)]

    @property
    def kind(self) -> str:
        """The event's kind, one of `KINDS`."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def names(self) -> tuple[str, ...]:
        """The receivers it concerns."""
        found = self.link if self.kind == "set" else getattr(self, self.kind)
        if self.kind in ("note", "jam") or found is None:
            return ()
        return (found,) if isinstance(found, str) else tuple(found)

    @property
    def first(self) -> int:
        """The slot in which it begins."""
        slot = self.at if self.at is not None else self.start
        assert slot is not None  # noqa: S101 - checked when it was made
        return slot


def _what_mistakes(table: Mapping[str, Any]) -> list[Found]:
    kinds = [kind for kind in KINDS if table.get(kind) is not None]
    found: list[Found] = []
    if len(kinds) != 1:
        said = f"has {listed(kinds)} at once" if kinds else "does not say what happens"
        found.append(("event", f'{said}; expected one of {listed(KINDS)}, such as cut = "legitimate"'))
    if kinds == ["set"] and table.get("link") is None:
        found.append(("link", 'is missing; expected the link that is changed, such as link = "legitimate"'))
    if "set" not in kinds and table.get("link") is not None:
        found.append(("link", "is given without set; expected what changes, such as set = { quality = 0.2 }"))
    if table.get("state") is not None and not {"kill", "restart"} & set(kinds):
        found.append(("state", "is given without a restart; remove the line"))
    if table.get("set") == {}:
        found.append(("set", "is empty; expected what changes, such as set = { quality = 0.2 }"))
    return found


def _when_mistakes(table: Mapping[str, Any]) -> list[Found]:
    at, start, to = (table.get(name) for name in ("at", "from", "to"))
    kinds = [kind for kind in KINDS if table.get(kind) is not None]
    if (at is None) == (start is None):
        return [("at", "and from are both there" if at is not None else "is missing; expected at = 400")]
    if start is None and to is not None:
        return [("to", "is given without from; expected from and to, or only at")]
    if start is not None and to is None:
        return [("to", "is missing, but from is given; expected the slot in which it ends")]
    if type(start) is int and type(to) is int and to <= start:
        return [("to", f"is {to}, not after from, which is {start}; expected a later slot")]
    if start is not None and len(kinds) == 1 and kinds[0] not in LASTING:
        return [("from", f"is given, but {kinds[0]} happens in one slot; expected at")]
    return []
