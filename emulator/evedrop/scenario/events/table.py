"""`[[event]]` as a table with the entries of all kinds: checked as a whole, then turned into an event of its kind.

So an unknown entry, a value of the wrong type, two kinds at once and a wrong time are all reported together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, ClassVar

from pydantic import Field, PlainValidator, SerializeAsAny, create_model

from evedrop.errors import NotRegistered
from evedrop.scenario.events import EVENTS
from evedrop.scenario.events.event import EventKind, When
from evedrop.scenario.table import Mistake
from evedrop.scenario.words import as_toml, listed


class EventTable(When):
    """`[[event]]`: a table with the entries of these kinds of event; any entry may be missing."""

    kinds: ClassVar[Mapping[str, type[EventKind]]]
    broken: ClassVar[Mapping[str, str]]
    """Kinds of installed packages that cannot be loaded → why, in words that follow the name."""

    def mistakes(self) -> Iterator[Mistake]:
        """Mistakes unless there is exactly one kind, with its time stated in one way."""
        given = [kind for name, kind in self.kinds.items() if getattr(self, name) is not None]
        yield from self._what_mistakes(given)
        yield from self._when_mistakes(given)

    def _what_mistakes(self, given: list[type[EventKind]]) -> Iterator[Mistake]:
        unloadable = [name for name in self.broken if getattr(self, name) is not None]
        yield from ((name, f"is an event{self.broken[name]}") for name in unloadable)
        if len(given) != 1 and not unloadable:
            problem = f"has {listed([kind.kind for kind in given])} at once" if given else "does not say what happens"
            yield "event", f'{problem}; expected one of {listed([*self.kinds])}, such as cut = "legitimate"'
        has = {entry for kind in given for entry in kind.own_entries()}
        alone = {entry: sentence for kind in self.kinds.values() for entry, sentence in kind.alone.items()}
        for entry, sentence in alone.items():
            if getattr(self, entry) is not None and entry not in has:
                yield entry, sentence
        for entry, field in given[0].model_fields.items() if len(given) == 1 else ():
            if field.is_required() and getattr(self, entry) is None:
                example = f"{entry} = {as_toml(field.examples[0])}" if field.examples else entry
                words = f"{field.description}, such as {example}" if field.description else example
                yield entry, f"is missing; expected {words}"

    def _when_mistakes(self, given: list[type[EventKind]]) -> Iterator[Mistake]:
        at, start, to = self.at, self.start, self.to
        if at is not None and start is not None:
            yield "at", "and from are both there"
        elif at is None and start is None:
            yield "at", "is missing; expected at = 400"
        elif start is None and to is not None:
            yield "to", "is given without from; expected from and to, or only at"
        elif start is not None and to is None:
            yield "to", "is missing, but from is given; expected the slot in which it ends"
        elif start is not None and to is not None and to <= start:
            yield "to", f"is {to}, not after from, which is {start}; expected a later slot"
        elif start is not None and len(given) == 1 and not given[0].lasts:
            yield "from", f"is given, but {given[0].kind} happens in one slot; expected at"


def event_table(entries: Iterable[str] | None = None) -> type[EventTable]:
    """The table of the built-in kinds; also of packages' kinds, if any of these entries is not built in, or for None."""
    built_in = _table_of(tuple(EVENTS.items()), ())
    if entries is not None and set(entries) <= set(built_in.entries()):
        return built_in
    kinds, broken = dict(EVENTS), {}
    for name in EVENTS.names:
        if EVENTS.foreign(name):
            try:
                kind = EVENTS[name]
            except NotRegistered as error:
                broken[name] = error.why
                continue
            if getattr(kind, "kind", None) == name and name in kind.own_entries():
                kinds[name] = kind
            else:
                broken[name] = f", whose class {kind.__name__} does not have that kind and that entry; expected both"
    return _table_of(tuple(kinds.items()), tuple(broken.items()))


@lru_cache(maxsize=8)
def _table_of(kinds: tuple[tuple[str, type[EventKind]], ...], broken: tuple[tuple[str, str], ...]) -> type[EventTable]:
    fields: dict[str, Any] = {}
    for _, kind in kinds:
        for entry in kind.own_entries():
            field = kind.model_fields[entry]
            annotation: Any = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
            fields.setdefault(entry, (annotation | None, Field(None, examples=field.examples)))
    fields |= {name: (Any, None) for name, _ in broken}
    table = create_model("EventTable", __base__=EventTable, **fields)
    table.kinds, table.broken = dict(kinds), dict(broken)
    return table


def event_of(given: object) -> EventKind:
    """The event that a table describes. Raises ValidationError with every mistake in it."""
    if isinstance(given, EventKind):
        return given
    table = event_table(given if isinstance(given, Mapping) else ())
    entries = table.model_validate(given).model_dump(exclude_none=True, exclude_unset=True)
    kind = next(kind for name, kind in table.kinds.items() if name in entries)
    return kind.model_validate(entries)


AnyEvent = Annotated[SerializeAsAny[EventKind], PlainValidator(event_of)]
