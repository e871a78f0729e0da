"""The lines of a TOML file in which its entries are, for messages about them. Which text is one entry, tomllib decides."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from evedrop.errors import ScenarioError

_HEADER = re.compile(r"\s*\[(\[?)(.*?)\]?\]\s*(#.*)?$")
_FEW = 50  # lines of an entry after each of which tomllib is asked; of a longer one, only where it may end
_ENDS = ("]", "}", '"""', "'''")


def lines_of_entries(text: str) -> dict[str, int]:
    """Dotted path → line, from 1, of each table and entry of a valid TOML text; inside a value there are no paths."""
    found: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for line, statement in _statements(text.splitlines()):
        header = _HEADER.match(statement)
        if header is not None and (named := _path(statement)) is not None:
            table = _with_places(named, counts, many=bool(header[1]))
            found.setdefault(table, line)
        elif (named := _path(statement)) is not None:
            found.setdefault(f"{table}.{named}" if table else named, line)
    return found


@contextmanager
def with_line_numbers(text: str, changed: Iterable[str] = ()) -> Iterator[None]:
    """Add to each mistake of a ScenarioError the line of its entry in the text, except of changed entries, by dotted key."""
    try:
        yield
    except ScenarioError as error:
        try:
            lines = lines_of_entries(text)
        except RecursionError:
            lines = {}
        begins = tuple(f"{path}." for path in changed)
        numbered = error.numbered(lambda path: None if f"{path}.".startswith(begins) else line_of(path, lines))
        raise numbered from error.__cause__


def line_of(path: str, lines: Mapping[str, int]) -> int | None:
    """The line of an entry, or of the innermost table or value that holds it; None if there is none."""
    while path:
        if path in lines:
            return lines[path]
        path = path.rpartition(".")[0]
    return None


def _statements(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Each table header and each entry with its value, with the line on which it begins."""
    first = 0
    while first < len(lines):
        stop = first + 1
        while stop < len(lines) and not _is_whole("\n".join(lines[first:stop])):
            stop += 1
            while stop < len(lines) and stop - first > _FEW and not lines[stop - 1].strip().endswith(_ENDS):
                stop += 1
        yield first + 1, "\n".join(lines[first:stop])
        first = stop


def _is_whole(text: str) -> bool:
    try:
        tomllib.loads(text)
    except ValueError:
        return False
    return True


def _path(statement: str) -> str | None:
    """The dotted path that a statement names; None if it names none, such as a comment."""
    try:
        inner: Any = tomllib.loads(statement)
    except ValueError:
        return None
    parts: list[str] = []
    # A header makes empty tables, and an entry with a dotted key makes tables of one entry, around its value.
    depth = statement.partition("=")[0].count(".") + 1 if _HEADER.match(statement) is None else 1000
    while len(parts) < depth and isinstance(inner := inner[0] if _is_list_of_table(inner) else inner, dict) and inner:
        name, inner = next(iter(inner.items()))
        parts.append(name)
    return ".".join(parts) or None


def _is_list_of_table(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 1 and isinstance(value[0], dict)


def _with_places(named: str, counts: dict[str, int], many: bool) -> str:
    """The path of a table, with the place of each list of tables that it is in; many: whether it is the next of such a list."""
    if many:
        counts[named] = counts.get(named, -1) + 1
    parts: list[str] = []
    plain = ""
    for part in named.split("."):
        plain = f"{plain}.{part}" if plain else part
        parts += [part, str(counts[plain])] if plain in counts else [part]
    return ".".join(parts)
