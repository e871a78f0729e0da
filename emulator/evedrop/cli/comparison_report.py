"""The terminal output of a comparison: the cost and secrecy of each scheme, then every pair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evedrop.cli.report import terminal
from evedrop.show.report.comparison import comparison_heading, comparison_lines, pairs_table, schemes_table

if TYPE_CHECKING:
    from evedrop.results.comparison import Comparison


def print_comparison(comparison: Comparison, folder: str) -> None:
    """Print a comparison on standard output."""
    console = terminal()
    console.print(comparison_heading(comparison))
    console.show(schemes_table(comparison), tight=True)
    console.show(pairs_table(comparison), tight=True, sections=True)
    for line in comparison_lines(comparison):
        console.print(line)
    console.print(f"results: {folder}/compare.json, compare.png, scenarios/")
