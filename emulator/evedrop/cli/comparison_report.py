"""The terminal output of a comparison: the cost and secrecy of each scheme, then every pair."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from evedrop.cli.report import rich_table, terminal
from evedrop.show.report.comparison import comparison_heading, comparison_lines, pairs_table, schemes_table

if TYPE_CHECKING:
    from evedrop.results.comparison import Comparison


def print_comparison(found: Comparison, folder: str) -> None:
    """Print a comparison on standard output."""
    console = terminal()
    console.print(comparison_heading(found))
    console.print(rich_table(schemes_table(found)))
    pairs = pairs_table(found)
    shown = rich_table(pairs)
    for row, (_, following) in zip(shown.rows, pairwise(pairs.rows), strict=False):
        row.end_section = bool(following[0])  # a scheme's name begins a section
    console.print(shown)
    for line in comparison_lines(found):
        console.print(line)
    console.print(f"results: {folder}/compare.json, compare.png, scenarios/")
