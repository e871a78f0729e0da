"""The entries of briefs, progress events and a run's status: each field says how it is checked, read and written.

The type and range of each value are checked before an object is made of it.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields
from enum import StrEnum
from functools import partial
from itertools import islice
from typing import Any, TypeVar

from evedrop.model.slot.link import NEVER
from evedrop.model.streams import KEY_BYTES

Check = Callable[[str, Any], Iterator[str]]
"""Takes a path and the value found there; yields a sentence for each mistake."""

_SHOWN = 40  # characters of a value that a message repeats
_MOST_TOLD = 8

T = TypeVar("T")


def _wrong(path: str, value: Any, expected: str) -> Iterator[str]:
    text = f"{type(value).__name__} of {len(value)}" if isinstance(value, (list, dict)) else repr(value)
    yield f"{path} is {text if len(text) <= _SHOWN else text[:_SHOWN] + '…'}, expected {expected}"


def text(path: str, value: Any) -> Iterator[str]:
    """Check that a value is a string."""
    if not isinstance(value, str):
        yield from _wrong(path, value, "a string")


def flag(path: str, value: Any) -> Iterator[str]:
    """Check that a value is true or false."""
    if type(value) is not bool:
        yield from _wrong(path, value, "true or false")


def anything(path: str, value: Any) -> Iterator[str]:
    """Accept any value: another check handles it."""
    del path, value
    yield from ()


def whole(least: int, most: int = NEVER) -> Check:
    """A check for a whole number in this range."""

    def check(path: str, value: Any) -> Iterator[str]:
        if type(value) is not int or not least <= value <= most:
            yield from _wrong(path, value, f"a whole number from {least} to {most}")

    return check


def number(path: str, value: Any) -> Iterator[str]:
    """Check that a value is a finite number."""
    if type(value) not in (int, float) or abs(value) > 1e308 or math.isnan(value):
        yield from _wrong(path, value, "a finite number")


def not_negative(path: str, value: Any) -> Iterator[str]:
    """Check that a value is a finite number, 0 or more."""
    wrong = list(number(path, value))
    yield from wrong or (_wrong(path, value, "a number of 0 or more") if value < 0 else ())


def choice(kind: type[StrEnum]) -> Check:
    """A check for one of the values of an enumeration."""

    def check(path: str, value: Any) -> Iterator[str]:
        if value not in [*kind]:
            yield from _wrong(path, value, f"one of {', '.join(kind)}")

    return check


def maybe(check: Check) -> Check:
    """A check for null, or a value that passes another check."""
    return lambda path, value: iter(()) if value is None else check(path, value)


def listed(check: Check) -> Check:
    """A check for a list of values that pass another check."""

    def all_of(path: str, value: Any) -> Iterator[str]:
        if not isinstance(value, list):
            yield from _wrong(path, value, "a list")
            return
        for i, element in enumerate(value):
            yield from check(f"{path}.{i}", element)

    return all_of


def row(*checks: Check) -> Check:
    """A check for a list with exactly one value for each of these checks, in their order."""

    def each(path: str, value: Any) -> Iterator[str]:
        if not isinstance(value, list) or len(value) != len(checks):
            yield from _wrong(path, value, f"a list of {len(checks)} entries")
            return
        for i, (check, element) in enumerate(zip(checks, value, strict=True)):
            yield from check(f"{path}.{i}", element)

    return each


def named(check: Check) -> Check:
    """A check for a table with any names, whose values pass another check."""

    def all_of(path: str, value: Any) -> Iterator[str]:
        if not isinstance(value, dict):
            yield from _wrong(path, value, "a table")
            return
        for name, element in value.items():
            if isinstance(name, str):
                yield from check(f"{path}.{name:.{_SHOWN}}", element)
            else:
                yield f"{path} has the name {name!r:.{_SHOWN}}, expected a string"

    return all_of


def table(needed: Mapping[str, Check], optional: Mapping[str, Check] | None = None, strict: bool = True) -> Check:
    """A check for a table with these entries; strict: any other entry is a mistake."""
    entries = {**needed, **(optional or {})}

    def each(path: str, value: Any) -> Iterator[str]:
        if not isinstance(value, dict):
            yield from _wrong(path or "it", value, "a table")
            return
        dot = f"{path}." if path else ""
        for name, check in entries.items():
            if name in value:
                yield from check(f"{dot}{name}", value[name])
            elif name in needed:
                yield f"{dot}{name} is missing"
        for name in value if strict else ():
            if name not in entries:
                yield f"{dot}{name!s:.{_SHOWN}} is an unknown entry"

    return each


def key(path: str, value: Any) -> Iterator[str]:
    """Check that a value is the key of a stream, in hexadecimal."""
    try:
        size = len(bytes.fromhex(value)) if isinstance(value, str) else 0
    except ValueError:
        size = 0
    if size != KEY_BYTES:  # the value may be a secret, so the message does not repeat it
        yield f"{path} is not a key, expected {KEY_BYTES} bytes in hexadecimal"


MATRIX = listed(listed(number))
NUMBERS = listed(number)
LIMITS = listed(maybe(number))
SLOT = whole(0)


def entry(check: Check, read: Callable[[Any], Any] | None = None, left_out: bool = False) -> dict[str, Any]:
    """The metadata of a field that is an entry.

    read: makes the field's value from the checked entry; by default they are the same. left_out: not written if it is None.
    """
    return {"check": check, "read": read or (lambda value: value), "left_out": left_out}


def inner(kind: type[Any], or_null: bool = False, left_out: bool = False) -> dict[str, Any]:
    """The metadata of a field that is itself a table of entries: an object of this dataclass.

    or_null: or None; left_out: or None, which is not written.
    """
    check = table_of(kind)
    if or_null or left_out:
        return entry(maybe(check), lambda value: None if value is None else read(kind, value), left_out)
    return entry(check, partial(read, kind))


def table_of(kind: type[Any]) -> Check:
    """A check for the table of a dataclass of entries; only entries with a default may be missing."""
    needed: dict[str, Check] = {}
    optional: dict[str, Check] = {}
    for field in fields(kind):
        (needed if field.default is MISSING else optional)[field.name] = field.metadata["check"]
    return table(needed, optional)


def expect(check: Check, path: str, value: Any) -> None:
    """Raise ValueError with the first mistakes in a value, if it has any."""
    mistakes = list(islice(check(path, value), _MOST_TOLD))
    if mistakes:
        raise ValueError("; ".join(mistakes))


def read(kind: type[T], entries: Mapping[str, Any]) -> T:
    """Make an object of a dataclass of entries from its table, which has passed its check."""
    given = (field for field in fields(kind) if field.name in entries)  # type: ignore[arg-type]
    return kind(**{field.name: field.metadata["read"](entries[field.name]) for field in given})


def plain(of: Any) -> dict[str, Any]:
    """The entries of an object of such a dataclass, as they are written; also serves as `default` of json.dump."""
    values = ((field, getattr(of, field.name)) for field in fields(of))
    return {field.name: value for field, value in values if value is not None or not field.metadata.get("left_out")}
