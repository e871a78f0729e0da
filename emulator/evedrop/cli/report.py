"""The results of runs and sweeps on the terminal: the tables and sentences of `evedrop.show.report`, at its width."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, final

from evedrop.cli.console import StyledConsole
from evedrop.cli.tables import TAKEN
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.scenario.recorded import recorded
from evedrop.score.summary import Summary
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report import closing
from evedrop.show.report.closing import sweep_table
from evedrop.show.report.comparison import (
    comparison_heading,
    comparison_lines,
    conclusion,
    left_out_schemes,
    pairs_table,
    schemes_table,
)
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.verdict_matrix import matrix_lines
from evedrop.show.terminal_tables import alarming, fitted
from evedrop.system.output import columns_of, print_json, say, wrapped, wrapped_command

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

    replay: the beginning of the command that shows one trial live; verbose: also print the page's notes on verdicts.
    """
    console = terminal()
    if summary.ended != "complete":
        console.say(f"{summary.ended.splitlines()[0]}; the results so far:", _WARNING)
    wide = console.width >= _DIGEST_WIDTH
    shown = closing.receivers_table(summary, wide)
    console.show(closing.receivers_table(summary, judged=True), shown, tight=not wide, heads="" if wide else "short")
    if summary.verdict is not None:
        console.say(summary.verdict.sentence, f"bold {_STYLES.get(summary.verdict.outcome, '')}")
        for outcome, line in closing.verdict_lines(summary):
            console.say(f"  {line}", _STYLES.get(outcome, ""))
    for line in closing.remarks(summary):
        console.say(line)
    directions = closing.directions_table(summary.directions) if summary.directions else None
    if verbose:
        _print_details(console, summary, directions, replay)
    else:
        if directions is not None:
            console.take(directions)
        if number := len(closing.doubtful(summary)):
            console.say(f"{number} of the means above {_UNCERTAIN[number > 1]}; --verbose says why", _WARNING)
    for line in closing.application_lines(summary):
        console.say(line)
    for expectation in summary.expectations:
        console.say(expectation.sentence)
        if expectation.replay is not None:
            console.command(f"    see it again: {expectation.replay}")
    console.say(f"results: {folder}; to look at them: {closing.looking(folder, summary)}")


def _print_details(console: ReportConsole, summary: Summary, directions: TextTable | None, replay: str | None) -> None:
    """Print the other parts of the report page: theory, leaks, directions, doubts, and the most surprising trial."""
    for line in closing.details(summary):
        console.say(line)
    if directions is not None:
        console.show(directions, tight=True)
    for line in closing.doubts(summary):
        console.say(line, _WARNING)
    surprise = closing.surprise(summary)
    if surprise is not None and summary.surprising is not None:
        console.say(surprise)
        if replay is not None:
            console.command(f"    watch it live: {replay} --first-trial {summary.surprising.trial} --trials 1")


def print_sweep(table: pa.Table, keys: tuple[str, ...], folder: str) -> None:
    """Print the table of a sweep: one row for each point and peer."""
    console = terminal()
    rows = table.to_pylist()
    console.show(sweep_table(rows, keys))
    for line in closing.sweep_doubts(rows):
        console.say(line, _WARNING)
    console.say(f"results: {folder}/sweep.parquet, sweep.png")


def left_out_line(left_out: Mapping[str, str], why: str) -> str:
    """The eavesdroppers that a design leaves out; left_out: name → strategy."""
    who = ", ".join(f"{name} ({strategy})" for name, strategy in left_out.items())
    return f"left out: {who}: {why}"


@final
class ReportConsole(StyledConsole):
    """What reports are printed on."""

    def __init__(self, file: TextIO, columns: int | None) -> None:
        """columns: in which sentences are broken into lines, and tables fit; None: whole sentences, tables in 140 columns."""
        super().__init__(file, highlight=False, markup=False, width=columns or 140, height=_HEIGHT)
        self._columns = columns

    def show(self, table: TextTable, drawn: TextTable | None = None, **how: Any) -> None:
        """Show a table as far as the terminal is wide enough; drawn: what is shown of it, if that is not all.

        how: arguments of `fitted`.
        """
        self.take(table)
        drawn = table if drawn is None else drawn
        if drawn.title:  # Rich would break it at the width of the table
            self.say(drawn.title)
        self.print(fitted(replace(drawn, title=""), self, **how))

    def take(self, *tables: TextTable) -> None:
        """Keep tables for the files of `--csv` and `--latex`."""
        taken = TAKEN.get()
        if taken is not None:
            taken += tables

    def say(self, line: str, style: str = "") -> None:
        """Print a paragraph, on a terminal in lines that are broken between words; words of failure are red."""
        self._print_whole(wrapped(line, self._columns), style)

    def command(self, line: str) -> None:
        """Print a command, on a terminal in lines that a shell can still read."""
        self._print_whole(wrapped_command(line, self._columns))

    def _print_whole(self, text: str, style: str = "") -> None:
        self.print(alarming(text, style), soft_wrap=True)


def terminal() -> ReportConsole:
    """A console on standard output."""
    return ReportConsole(sys.stdout, columns_of(sys.stdout))


def printed(show: Callable[[ReportConsole], None], columns: int) -> str:
    """What a function prints, as text in lines of at most this many columns."""
    text = io.StringIO()
    show(ReportConsole(text, columns))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines() if line.strip())


_HEIGHT = 25  # which nothing depends on; without it Rich makes a dumb terminal 80 columns wide


def print_comparison(comparison: Comparison, folder: str, verbose: bool = False) -> None:
    """Print a comparison on standard output: the matrix of verdicts and the conclusion; verbose: all tables and notes too."""
    console = terminal()
    console.say(comparison_heading(comparison))
    for line in matrix_lines(comparison, console.width):
        console.say(line)
    tables = schemes_table(comparison), pairs_table(comparison)
    if verbose:
        console.show(tables[0], tight=True)
        console.show(tables[1], tight=True, sections=True)
    else:
        console.take(*tables)
    for line in comparison_lines(comparison) if verbose else left_out_schemes(comparison):
        console.say(line)
    console.say(conclusion(comparison), "bold")
    rest = "" if verbose else "; every error, cost and note: --verbose, --csv FILE or report.html"
    console.say(f"results: {folder}/compare.json, compare.png, scenarios/{rest}")


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


def report_page(folder: Path, silent: bool = False, write: Callable[[Path], Path] | None = None) -> None:
    """Write report.html into a results folder, and say where it is; a page that cannot be written gives a warning.

    silent: do not say where, for example because standard output is JSON; write: what writes it; `write_report` by default.
    """
    from evedrop.show.report.writing import try_report, write_report

    path = try_report(folder, write or write_report)
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
