"""Tables on the terminal, drawn by Rich: one that does not fit is shown row by row, one entry per line. Nothing is cut off."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, Group
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from evedrop.show.report.text_table import TextTable

_ENDLESS = 10_000  # columns


def rich_table(table: TextTable, *, tight: bool = False, short_heads: bool = False, sections: bool = False) -> Table:
    """A table for the terminal.

    tight: without room at its sides and between columns; short_heads: on two lines; sections: with a line above each row whose
    first cell is not empty.
    """
    shown = Table(
        title=table.title or None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=not tight,
        collapse_padding=tight,
    )
    for column in table.columns:
        heading = column.heading.replace(" ", "\n", 1) if short_heads else column.heading
        shown.add_column(heading, justify="right" if column.number else "left", no_wrap=not column.wraps)
    for row, following in pairwise([*table.rows, ("",)]):
        shown.add_row(*row, end_section=sections and bool(following[0]))
    return shown


def fitted(table: Table, console: Console) -> Table | Group:
    """The table if the console is wide enough for it; otherwise its rows, each with its first cell as a heading."""
    for column in table.columns:
        if column.no_wrap:  # Rich would rather cut such a cell off than make the table wider; it wraps the head
            column.min_width = max(map(cell_len, (*str(column.header).split(), *map(str, column.cells))), default=0)
    wanted = Measurement.get(console, console.options.update(width=_ENDLESS), table).minimum
    if wanted <= console.width:
        return table
    return Group(*([Text(str(table.title))] if table.title else []), *_rows(table))


def _rows(table: Table) -> Iterator[Padding | Text]:
    heads = [" ".join(str(column.header).split()) for column in table.columns]
    cells = [list(column.cells) for column in table.columns]
    above = ""
    for row in zip(*cells, strict=True):
        first, *others = [str(cell) for cell in row]
        above = first or above  # a cell that is left empty repeats the one above it
        yield Text()
        yield Text(f"{heads[0]} {above}".strip())
        inner = Table.grid(padding=(0, 2))
        for head, cell in zip(heads[1:], others, strict=True):
            if cell:
                inner.add_row(head, cell)
        yield Padding(inner, (0, 0, 0, 2))
