"""The results of runs and sweeps on the terminal: the tables and sentences of `evedrop.show.report`, at its width."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from evedrop.cli.console import StyledConsole
from evedrop.cli.tables import TAKEN
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.scenario.recorded import recorded
from evedrop.score.summary import Summary
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report import closing
from evedrop.show.report.closing import sweep_table
from evedrop.show.report.comparison import comparison_heading, comparison_lines, pairs_table, schemes_table
from evedrop.show.report.text_table import TextTable
from evedrop.show.terminal_tables import fitted, rich_table
from evedrop.system.output import print_json, say

if TYPE_CHECKING:
    import pyarrow as pa

    from evedrop.results.comparison import Comparison


_FAILURE, _WARNING = "red", "yellow"
_UNCERTAIN = {False: "is uncertain", True: "are uncertain"}
_STYLES = {
    SecrecyOutcome.PERFECT: "",
    SecrecyOutcome.RELATIVE: "",
    SecrecyOutcome.OPEN: _WARNING,
    SecrecyOutcome.BROKEN: _FAILURE,
}
_DIGEST_WIDTH = 100
"""The least width of a terminal, in columns, to show digests, and the standard error of every metric."""


def print_summary(summary: Summary, folder: str, replay: str | None = None, verbose: bool = False) -> None:
    """Print the closing report on standard output.

    replay: the beginning of the command that shows one trial live; verbose: with everything that the report page says.
    """
    console = terminal()
    if summary.ended != "complete":
        console.line_of(f"{summary.ended.splitlines()[0]}; the results so far:", _WARNING)
    console.show(closing.receivers_table(summary), closing_table(summary, console.width))
    if summary.verdict is not None:
        console.line_of(summary.verdict.sentence, f"bold {_STYLES.get(SecrecyOutcome(summary.verdict.outcome), '')}")
        for outcome, line in closing.verdict_lines(summary):
            console.line_of(f"  {line}", _STYLES.get(outcome, ""))
    for line in closing.remarks(summary):
        console.line_of(line)
    doubts = list(closing.doubts(summary))
    if verbose:
        _print_details(console, summary, replay)
    elif doubts:
        console.line_of(f"{len(doubts)} of the means above {_UNCERTAIN[len(doubts) > 1]}; --verbose says why", _WARNING)
    for line in closing.application_lines(summary):
        console.line_of(line)
    for expectation in summary.expectations:
        console.line_of(expectation.sentence, "" if expectation.held else _FAILURE)
        if expectation.replay is not None:
            console.line_of(f"    see it again: {expectation.replay}")
    console.line_of(f"results: {folder}; to look at them: evedrop view {folder}")


def _print_details(console: _Console, summary: Summary, replay: str | None) -> None:
    """Print what the report page says besides: theory, leaks, directions, doubts, and the most surprising trial."""
    for line in closing.details(summary):
        console.line_of(line)
    if summary.directions:
        console.show(closing.directions_table(summary.directions), tight=True)
    for line in closing.doubts(summary):
        console.line_of(line)
    surprise = closing.surprise(summary)
    if surprise is not None and summary.surprising is not None:
        console.line_of(surprise)
        if replay is not None:
            console.line_of(f"    watch it live: {replay} --first-trial {summary.surprising.trial} --trials 1")


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

    def line_of(self, text: str, style: str = "") -> None:
        """Print a line; on a terminal, one that is too long is divided between words."""
        self.print(Text(text, style), soft_wrap=not self.is_terminal)


def terminal() -> _Console:
    """A console on standard output; 140 columns wide if that is not a terminal."""
    return _Console(
        sys.stdout,
        highlight=False,
        markup=False,
        soft_wrap=True,
        width=None if sys.stdout.isatty() else 140,
    )


def print_comparison(comparison: Comparison, folder: str) -> None:
    """Print a comparison on standard output."""
    console = terminal()
    console.print(comparison_heading(comparison))
    console.show(schemes_table(comparison), tight=True)
    console.show(pairs_table(comparison), tight=True, sections=True)
    for line in comparison_lines(comparison):
        console.print(line)
    console.print(f"results: {folder}/compare.json, compare.png, scenarios/")


def print_results(folder: Path, as_json: bool = False, verbose: bool = False) -> None:
    """Print the table and the verdict of a results folder, or its summary as JSON, to standard output; verbose: all details.

    Raises UsageError if it is not a results folder.
    """
    results = Results.read(folder)
    if as_json:
        print_json(results.summary)
        return
    summary = results.typed_summary
    print_summary(summary, str(folder), None if summary.mode == "live" else replay_command(folder), verbose)


def report_page(folder: Path, silent: bool = False) -> None:
    """Write report.html into a results folder, and say where it is; a page that cannot be written gives a warning.

    silent: do not say where, for example because standard output is JSON.
    """
    from evedrop.show.report.writing import try_report

    path = try_report(folder)
    if path is not None and not silent:
        sys.stdout.write(f"report: {path}\n")


def print_report_line(folder: Path) -> None:
    """Say where the page of a results folder is, if it has one."""
    from evedrop.show.report.writing import REPORT

    if (folder / REPORT).exists():
        sys.stdout.write(f"report: {folder / REPORT}\n")


def print_ending(folder: Path, status: int, how: str) -> None:
    """Print the output of `evedrop run` at its end: the closing report, and the reason for a failure.

    status: the exit status of the run; how: why it failed.
    """
    with contextlib.suppress(UsageError):
        print_results(folder)
        report_page(folder)
    sys.stdout.flush()
    if status not in {0, 1}:
        say(how)
        sys.stderr.flush()


def replay_command(folder: Path) -> str | None:
    """The command that runs one trial of a results folder's scenario live; None if it cannot be run live."""
    try:
        scenario = recorded(folder, beyond_horizon=False).scenario
    except UsageError:  # float64 cannot represent the states of that many slots
        return None
    trials = " --record-trials 1" if scenario.record_trials > 1 else ""
    trials += " --set shards=1" if scenario.shards > 1 else ""
    # A quantile over trials can be expected only of many trials.
    expected = " --set 'expect=[]'" if any(expectation.quantile is not None for expectation in scenario.expect) else ""
    return f"evedrop run {shlex.quote(str(folder))} --pace 0.02{trials}{expected}"
