"""Tables on narrow terminals: a table that does not fit is shown row by row, one entry per line."""

from __future__ import annotations

from collections.abc import Iterator

from rich.cells import cell_len
from rich.console import Console, Group
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

_ENDLESS = 10_000  # columns


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
