"""The closing table of a wire, and the sentences below it, as text.

Source: docs/wire.md, the summary.
"""

from __future__ import annotations

import io
import shutil

from rich.console import Console

from evedrop.results.wire_summary import WireSummary
from evedrop.show.report.wire import wire_sentences, wire_table
from evedrop.show.terminal_tables import rich_table


def closing_lines(summary: WireSummary) -> list[str]:
    """The table of the links, and the sentences."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=False, width=max(100, shutil.get_terminal_size().columns))
    console.print(rich_table(wire_table(summary)))
    return [*(line.rstrip() for line in text.getvalue().splitlines()), *wire_sentences(summary)]
