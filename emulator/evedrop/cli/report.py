"""The results of runs and sweeps on the terminal: the tables and sentences of `evedrop.show.report`, at its width."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.table import Table

from evedrop.cli.console import StyledConsole
from evedrop.cli.tables import TAKEN
from evedrop.score.summary import Summary
from evedrop.show.report import closing
from evedrop.show.report.sweep import sweep_table
from evedrop.show.report.text_table import TextTable
from evedrop.show.terminal_tables import fitted, rich_table

if TYPE_CHECKING:
    import pyarrow as pa


_DIGEST_WIDTH = 100
"""The least width of a terminal, in columns, to show digests, and the standard error of every metric."""


def print_summary(summary: Summary, folder: str, replay: str | None = None) -> None:
    """Print the closing report on standard output; replay: the beginning of the command that shows one trial live."""
    console = terminal()
    if summary.ended != "complete":
        console.print(f"{summary.ended.splitlines()[0]}; the results so far:")
    console.show(closing.receivers_table(summary), closing_table(summary, console.width))
    for line in (*closing.remarks(summary), *closing.verdicts(summary)):
        console.print(line)
    if summary.directions:
        console.show(closing.directions_table(summary.directions), tight=True)
    for line in (*closing.doubts(summary), *closing.application_lines(summary)):
        console.print(line)
    for expectation in summary.expectations:
        console.print(expectation.sentence)
        if expectation.replay is not None:
            console.print(f"    see it again: {expectation.replay}")
    surprise = closing.surprise(summary)
    if surprise is not None and summary.surprising is not None:
        console.print(surprise)
        if replay is not None:
            console.print(f"    watch it live: {replay} --first-trial {summary.surprising.trial} --trials 1")
    console.print(f"results: {folder}; to look at them: evedrop view {folder}")


def closing_table(summary: Summary, width: int) -> Table:
    """The table of the receivers: their metrics and, if there is room, their digests; width: of the terminal, in columns."""
    wide = width >= _DIGEST_WIDTH
    return rich_table(closing.receivers_table(summary, wide), tight=not wide, short_heads=not wide)


def print_sweep(table: pa.Table, keys: tuple[str, ...], folder: str) -> None:
    """Print the table of a sweep: one row for each point and peer."""
    console = terminal()
    console.show(sweep_table(table.to_pylist(), keys))
    console.print(f"results: {folder}/sweep.parquet, sweep.png")


def left_out_line(left_out: Mapping[str, str], why: str) -> str:
    """The eavesdroppers that a design leaves out; left_out: name → strategy."""
    who = ", ".join(f"{name} ({strategy})" for name, strategy in left_out.items())
    return f"left out: {who}: {why}"


class _Console(StyledConsole):
    def show(self, table: TextTable, drawn: Table | None = None, **how: bool) -> None:
        """Show a table, row by row if it is wider than the terminal; drawn: what is shown of it, if that is not all.

        how: arguments of `rich_table`.
        """
        taken = TAKEN.get()
        if taken is not None:
            taken.append(table)
        self.print(fitted(rich_table(table, **how) if drawn is None else drawn, self))


def terminal() -> _Console:
    """A console on standard output; 140 columns wide if that is not a terminal."""
    return _Console(
        sys.stdout,
        highlight=False,
        markup=False,
        soft_wrap=True,
        width=None if sys.stdout.isatty() else 140,
    )
