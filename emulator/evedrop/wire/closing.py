"""The closing table of a wire, and the sentences below it, as text.

Source: docs/wire.md, the summary.
"""

from __future__ import annotations

import io
import shutil

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from evedrop.results.wire_summary import WireSummary
from evedrop.show.report.wire import wire_sentences, wire_table


def closing_lines(summary: WireSummary) -> list[str]:
    """The table of the links, and the sentences."""
    text, found = io.StringIO(), wire_table(summary)
    table = Table(title=found.title, title_justify="left", box=SIMPLE_HEAD)
    for column in found.columns:
        table.add_column(column.heading, justify="right" if column.number else "left", no_wrap=True)
    for row in found.rows:
        table.add_row(*row)
    Console(file=text, force_terminal=False, width=max(100, shutil.get_terminal_size().columns)).print(table)
    return [*(line.rstrip() for line in text.getvalue().splitlines()), *wire_sentences(summary)]
