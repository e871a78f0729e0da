"""The lines of a TOML file in which its entries are, for messages about them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from evedrop.errors import ScenarioError

# All that a bracket, an equals sign or the end of a line may mean in a valid text; strings and comments hide others. No group is
# repeated possessively: the `re` of Python 3.11.2, which is Debian 12's, does not match such a repetition.
_TOKEN = re.compile(
    r"""
    (?P<string> \"""(?: [^"\\]++ | \\. | "{1,2}(?!") )*"{3,5} | '''.*?'{3,5}
              | "(?: [^"\\]++ | \\. )*" | '[^']*+' )
    | (?P<opens> [\[{] ) | (?P<closes> [\]}] ) | (?P<equals> = ) | (?P<end> (?:\#[^\n]*+)?\n )
    """,
    re.DOTALL | re.VERBOSE,
)


def lines_of_entries(text: str) -> dict[str, int]:
    """Dotted path → line, from 1, of each table and entry of a valid TOML text; inside a value there are no paths."""
    return dict(reversed([*_paths(text)]))  # the first line of each path


def given_twice(text: str, line: int) -> str | None:
    """The entry of this line that an earlier line gives too, in words; None if there is none.

    text: valid TOML in front of this line, which may be the last of its entry.
    """
    try:
        *earlier, (path, at) = _paths("\n".join(text.split("\n")[:line]))
    except ValueError:  # no entry, or none that can be read
        return None
    lines = dict(reversed(earlier))  # the first line of each path
    inside = next((other_path for other_path in lines if other_path.startswith(f"{path}.")), None)
    around = max((other_path for other_path in lines if path.startswith(f"{other_path}.")), key=len, default=None)
    first = path if path in lines else inside or around
    if first is None:
        return None
    before = f"line {lines[first]}" if first == path else f"line {lines[first]}, as {first}"
    return f"{path} in line {at} is given already in {before}; leave one of them out"


@contextmanager
def with_line_numbers(text: str, changed: Iterable[str] = ()) -> Iterator[None]:
    """Add to each mistake of a ScenarioError the line of its entry in the text, except of changed entries, by dotted key."""
    try:
        yield
    except ScenarioError as error:
        lines = lines_of_entries(text)
        begins = tuple(f"{path}." for path in changed)
        rows = text.split("\n")
        raise error.numbered(
            lambda path: None if f"{path}.".startswith(begins) else line_of(path, lines),
            lambda mistake, line: _excerpt_of(mistake, rows[line - 1], line),
        ) from None


def _excerpt_of(mistake: str, row: str, line: int) -> str:
    path, _, rest = mistake.partition(":")
    return excerpt(row, line, path, key="is not an entry" in rest)


_LONGEST = 68  # characters of a line that is shown, so that it fits 80 columns
_VALUE = r"""("[^"]*"|'[^']*'|\[.*\]|\{.*\}|[^\s,}\]\#]+)"""
_TABLE = re.compile(r"\{(?:[^{}]++|\{[^{}]*+\})*\}")
"""A table within a line, which may hold tables."""


def excerpt(row: str, line: int, path: str = "", *, key: bool = False, column: int | None = None) -> str:
    """A line of a file, and below it carets: below the value of the entry with this dotted path, or below its key.

    If the line does not have this entry, the carets are below the header or the first key. column: where a single caret is, from
    0, in place of them. Empty if that is too far right to be shown.
    """
    row = row.removesuffix("\r")
    statement = row.strip() if row.lstrip().startswith("[") else row.partition("=")[0].strip()
    begin, end = row.find(statement), row.find(statement) + len(statement)
    entry = _entry_in(row, path) if path else None
    if column is not None:
        begin, end = column, column + 1
    elif entry is not None:
        begin, end = entry.span(1 if key else 2)
    shown = row[:_LONGEST].expandtabs(1)
    if begin >= len(shown) + 1:
        return ""
    marks = " " * begin + "^" * max(1, min(end, len(shown)) - begin)
    margin = " " * len(str(line))
    return f"   {line} | {shown}{'…' if len(row) > _LONGEST else ''}\n   {margin} | {marks}"


def _entry_in(row: str, path: str) -> re.Match[str] | None:
    """The key and the value of an entry, of those of its name the one in its table; None if the line does not have it."""
    *tables, name = path.split(".")
    begin = 0
    for table in tables:
        if (found := re.compile(rf"(?<![\w-]){re.escape(table)}\s*=").search(row, begin)) is not None:
            begin = found.end()
        elif table.isdecimal() and len(items := [*_TABLE.finditer(row, begin)]) > int(table):
            begin = items[int(table)].start()
    entry = re.compile(rf"(?<![\w-])({re.escape(name)})\s*=\s*{_VALUE}")
    return entry.search(row, begin) or entry.search(row)


def line_of(path: str, lines: Mapping[str, int]) -> int | None:
    """The line of an entry, or of the innermost table or value that holds it; None if the file has neither."""
    while path:
        if path in lines:
            return lines[path]
        path = path.rpartition(".")[0]
    return None


def _paths(text: str) -> Iterator[tuple[str, int]]:
    """The dotted path of each table and entry, with its line."""
    counts: dict[str, int] = {}
    table = ""
    for line, statement in _statements(text):
        if statement.startswith("["):
            path = table = _with_places(_parts(statement), counts, many=statement.startswith("[["))
        else:
            named = ".".join(_parts(f"{statement} = 0"))
            path = f"{table}.{named}" if table else named
        yield path, line


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Each table header and the key of each entry, with its line."""
    line, begin, depth, has_key = 1, 0, 0, False
    for token in _TOKEN.finditer(f"{text}\n"):
        kind = token.lastgroup
        depth += (kind == "opens") - (kind == "closes")
        if depth:
            continue
        if kind == "equals":
            yield line, text[begin : token.start()].strip()
            has_key = True
        elif kind == "end":
            if not has_key and (header := text[begin : token.start()].strip()):
                yield line, header
            line += text.count("\n", begin, token.end())
            begin, has_key = token.end(), False


def _parts(statement: str) -> list[str]:
    """The parts of the path that a header, or an entry whose value is a number, names."""
    inner: Any = tomllib.loads(statement)
    parts: list[str] = []
    while isinstance(inner, (dict, list)) and inner:
        if isinstance(inner, list):
            inner = inner[0]
        else:
            name, inner = next(iter(inner.items()))
            parts.append(name)
    return parts


def _with_places(parts: list[str], counts: dict[str, int], many: bool) -> str:
    """The path of a table, with the place of each list of tables that it is in; many: whether it is the next of such a list."""
    path = ""
    for i, part in enumerate(parts):
        path = f"{path}.{part}" if path else part
        if many and i == len(parts) - 1:
            counts[path] = counts.get(path, -1) + 1
        if path in counts:
            path = f"{path}.{counts[path]}"
    return path
