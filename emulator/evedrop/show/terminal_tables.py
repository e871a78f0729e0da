"""Tables on the terminal, drawn by Rich: one that does not fit leaves out standard errors, then columns, and says which."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, Group
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from evedrop.model.metrics.text import ShownNumber
from evedrop.show.report.text_table import TextTable
from evedrop.system.output import spelled

_ENDLESS = 10_000  # columns
_ALARMS = re.compile("FAILED|BROKEN|✗|\\bNO\\b")
_PARTS_OF_KEYS = re.compile(r"(?<=\w\w[._])(?=\w\w)")


def rich_table(
    table: TextTable, *, tight: bool = False, sections: bool = False, heads: str = "", encoding: str = "utf-8"
) -> Table:
    """A table for the terminal.

    tight: without room at its sides and between columns; sections: with a line above each row whose first cell is not empty;
    heads: "short" breaks headings at their first space, "broken" between all words, and keys of entries at dots; encoding: of the
    terminal, which may have to spell characters, so that they take more room.
    """
    shown = Table(
        title=alarming(table.title) if table.title else None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=not tight,
        collapse_padding=tight,
    )
    for column in table.columns:
        heading = spelled(column.heading, encoding).replace(" ", "\n", {"": 0, "short": 1}.get(heads, -1))
        heading = _PARTS_OF_KEYS.sub("\n", heading) if heads == "broken" else heading
        shown.add_column(heading, justify="right" if column.number else "left", no_wrap=not column.wraps)
    for row, following in pairwise([*table.rows, ("",)]):
        shown.add_row(*(_cell(cell, encoding) for cell in row), end_section=sections and bool(following[0]))
    return shown


def _cell(text: str, encoding: str) -> Text:
    shown = alarming(text)
    words = spelled(text, encoding)
    return shown if words == text else Text(words, "bold red" if shown.spans else "")


def alarming(text: str, style: str = "") -> Text:
    """A text in a style, with the words that report a failure in red."""
    shown = Text(text, style)
    shown.highlight_regex(_ALARMS, "bold red")
    return shown


def fitted(
    table: TextTable, console: Console, *, tight: bool = False, sections: bool = False, heads: str = ""
) -> Table | Group:
    """A table that is no wider than the console, and below it the names of the columns that had no room.

    tight, sections, heads: as for `rich_table`.
    """
    forms = ((tight, heads), (True, heads), (True, "short"), (True, "broken"))
    rich = partial(rich_table, sections=sections, encoding=console.encoding)
    folded, without = rich(table, tight=True, heads="broken"), list[str]()
    for version, left_out in _versions(table):
        for narrow, broken in forms:
            drawn = rich(version, tight=narrow, heads=broken)
            if _fits(drawn, console):
                return _noted(drawn, left_out)
        if not table.least or len(left_out) <= len(table.least):
            folded, without = drawn, left_out
    for column in folded.columns:
        column.min_width, column.no_wrap, column.overflow = None, False, "fold"
    return _noted(folded, without)


def _noted(drawn: Table, left_out: list[str]) -> Table | Group:
    return Group(drawn, Text(f"no room for: {', '.join(left_out)}", "dim")) if left_out else drawn


def _fits(table: Table, console: Console) -> bool:
    """Whether a table is no wider than the console; its cells then keep their width."""
    for column in table.columns:
        if column.no_wrap:  # Rich would rather cut such a cell off than make the table wider
            texts = (*str(column.header).split("\n"), *map(str, column.cells))
            column.min_width = max(map(cell_len, texts), default=0)
    return Measurement.get(console, console.options.update(width=_ENDLESS), table).minimum <= console.width


def _versions(table: TextTable) -> Iterator[tuple[TextTable, list[str]]]:
    """The table, each time with less in it, and what is left out; it keeps its first column and another."""
    yield table, []
    left_out: list[str] = []
    bare = replace(table, rows=[tuple(map(_without_error, row)) for row in table.rows])
    if bare.rows != table.rows:
        left_out.append("± standard errors")
        yield bare, [*left_out]
    heads = [column.heading for column in table.columns]
    order = [*table.least, *(head for head in dict.fromkeys(reversed(heads)) if head not in table.least)]
    kept = [i for i in range(len(heads)) if any(row[i] for row in table.rows)]
    for heading in order:
        fewer = [i for i in kept if heads[i] != heading or i == 0]
        if len(fewer) < 2 or len(fewer) == len(kept):
            continue
        kept = fewer
        left_out.append(heading or "notes")
        columns = [table.columns[i] for i in kept]
        yield replace(bare, columns=columns, rows=[tuple(row[i] for i in kept) for row in bare.rows]), [*left_out]


def _without_error(cell: str) -> str:
    if isinstance(cell, ShownNumber) and cell.error is not None:
        return cell.partition(" ± ")[0] + cell.after
    return cell
