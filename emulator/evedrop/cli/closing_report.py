"""The closing report of a results folder: printed when a run ends, and again on request."""

from __future__ import annotations

import contextlib
import shlex
import sys
from pathlib import Path

from evedrop.cli.report import print_summary
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.scenario.loading.recorded import recorded
from evedrop.system.output import print_json, say


def print_results(folder: Path, as_json: bool = False) -> None:
    """Print the table and the verdict of a results folder, or its summary as JSON, to standard output.

    Raises UsageError if it is not a results folder.
    """
    results = Results.read(folder)
    if as_json:
        print_json(results.summary)
        return
    summary = results.typed_summary
    print_summary(summary, str(folder), None if summary.mode == "live" else replay_command(folder))


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
