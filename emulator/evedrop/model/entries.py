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


def _wrong(path: str, found: Any, expected: str) -> Iterator[str]:
    text = f"{type(found).__name__} of {len(found)}" if isinstance(found, (list, dict)) else repr(found)
    yield f"{path} is {text if len(text) <= _SHOWN else text[:_SHOWN] + '…'}, expected {expected}"


def text(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a string."""
    if not isinstance(found, str):
        yield from _wrong(path, found, "a string")


def flag(path: str, found: Any) -> Iterator[str]:
    """Check that a value is true or false."""
    if type(found) is not bool:
        yield from _wrong(path, found, "true or false")


def anything(path: str, found: Any) -> Iterator[str]:
    """Accept any value: another check handles it."""
    del path, found
    yield from ()


def whole(least: int, most: int = NEVER) -> Check:
    """A check for a whole number in this range."""

    def check(path: str, found: Any) -> Iterator[str]:
        if type(found) is not int or not least <= found <= most:
            yield from _wrong(path, found, f"a whole number from {least} to {most}")

    return check


def number(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a finite number."""
    if type(found) not in (int, float) or abs(found) > 1e308 or math.isnan(found):
        yield from _wrong(path, found, "a finite number")


def not_negative(path: str, found: Any) -> Iterator[str]:
    """Check that a value is a finite number, 0 or more."""
    wrong = list(number(path, found))
    yield from wrong or (_wrong(path, found, "a number of 0 or more") if found < 0 else ())


def choice(kind: type[StrEnum]) -> Check:
    """A check for one of the values of an enumeration."""

    def check(path: str, found: Any) -> Iterator[str]:
        if found not in [*kind]:
            yield from _wrong(path, found, f"one of {', '.join(kind)}")

    return check


def maybe(check: Check) -> Check:
    """A check for null, or a value that passes another check."""
    return lambda path, found: iter(()) if found is None else check(path, found)


def listed(check: Check) -> Check:
    """A check for a list of values that pass another check."""

    def all_of(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, list):
            yield from _wrong(path, found, "a list")
            return
        for i, one in enumerate(found):
            yield from check(f"{path}.{i}", one)

    return all_of


def row(*checks: Check) -> Check:
    """A check for a list with exactly one value for each of these checks, in their order."""

    def each(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, list) or len(found) != len(checks):
            yield from _wrong(path, found, f"a list of {len(checks)} entries")
            return
        for i, (check, one) in enumerate(zip(checks, found, strict=True)):
            yield from check(f"{path}.{i}", one)

    return each


def named(check: Check) -> Check:
    """A check for a table with any names, whose values pass another check."""

    def all_of(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, dict):
            yield from _wrong(path, found, "a table")
            return
        for name, one in found.items():
            if isinstance(name, str):
                yield from check(f"{path}.{name:.{_SHOWN}}", one)
            else:
                yield f"{path} has the name {name!r:.{_SHOWN}}, expected a string"

    return all_of


def table(needed: Mapping[str, Check], optional: Mapping[str, Check] | None = None, strict: bool = True) -> Check:
    """A check for a table with these entries; strict: any other entry is a mistake."""
    known = {**needed, **(optional or {})}

    def each(path: str, found: Any) -> Iterator[str]:
        if not isinstance(found, dict):
            yield from _wrong(path or "it", found, "a table")
            return
        dot = f"{path}." if path else ""
        for name, check in known.items():
            if name in found:
                yield from check(f"{dot}{name}", found[name])
            elif name in needed:
                yield f"{dot}{name} is missing"
        for name in found if strict else ():
            if name not in known:
                yield f"{dot}{name!s:.{_SHOWN}} is an unknown entry"

    return each


def key(path: str, found: Any) -> Iterator[str]:
    """Check that a value is the key of a stream, in hexadecimal."""
    try:
        size = len(bytes.fromhex(found)) if isinstance(found, str) else 0
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
    return {"check": check, "read": read or (lambda found: found), "left_out": left_out}


def inner(kind: type[Any], or_null: bool = False, left_out: bool = False) -> dict[str, Any]:
    """The metadata of a field that is itself a table of entries: an object of this dataclass.

    or_null: or None; left_out: or None, which is not written.
    """
    check = table_of(kind)
    if or_null or left_out:
        return entry(maybe(check), lambda found: None if found is None else read(kind, found), left_out)
    return entry(check, partial(read, kind))


def table_of(kind: type[Any]) -> Check:
    """A check for the table of a dataclass of entries; only entries with a default may be missing."""
    needed: dict[str, Check] = {}
    optional: dict[str, Check] = {}
    for one in fields(kind):
        (needed if one.default is MISSING else optional)[one.name] = one.metadata["check"]
    return table(needed, optional)


def expect(check: Check, path: str, found: Any) -> None:
    """Raise ValueError with the first mistakes in a value, if it has any."""
    mistakes = list(islice(check(path, found), _MOST_TOLD))
    if mistakes:
        raise ValueError("; ".join(mistakes))


def read(kind: type[T], found: Mapping[str, Any]) -> T:
    """Make an object of a dataclass of entries from its table, which has passed its check."""
    given = (one for one in fields(kind) if one.name in found)  # type: ignore[arg-type]
    return kind(**{one.name: one.metadata["read"](found[one.name]) for one in given})


def plain(of: Any) -> dict[str, Any]:
    """The entries of an object of such a dataclass, as they are written; also serves as `default` of json.dump."""
    values = ((one, getattr(of, one.name)) for one in fields(of))
    return {one.name: value for one, value in values if value is not None or not one.metadata.get("left_out")}
