"""The end of a run that its own recorder could not complete: it was killed, or its disk was full.

Source: docs/results.md, while a run goes on.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import replace
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.results.crash_proof_tables import finish, is_unfinished, last_round
from evedrop.results.folder import UNFINISHED
from evedrop.results.reading import Results, age_of_metrics
from evedrop.results.summary_file import write_summary
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary
from evedrop.system.world import world


def note_end(folder: Path, scenario: Scenario, how: str) -> Summary:
    """Write the reason for the run's end into its summary, and finish the tables that could not be finished before.

    The metrics are the last that were written; if they are of an earlier slot than the rows, the first line of `ended` says so.

    Raises OSError if the folder cannot be written.
    """
    left_behind = is_unfinished(folder)
    rows = last_round(folder)
    how = noted(how, _age_told(folder) if (folder / "summary.json").exists() else age_of_metrics(folder))
    try:
        summary = replace(Results.read(folder).typed_summary, ended=how)
    except UsageError:  # there are no metrics
        run_tally = RunTally.nothing(scenario, scenario.trials)
        summary = summary_of(scenario, run_tally, dict.fromkeys(scenario.digested), RunOutcome(0.0, how))
        summary = replace(summary, slots=rows.slots)
        if not rows.at:
            left_behind = False
            world().disk.remove_tree(folder / UNFINISHED, ignore_errors=True)
            if not any(folder.glob("*.parquet")):
                with ResultsWriter(folder, scenario):
                    pass
    if left_behind:
        # The recording lacks its end; `evedrop view` makes another one from the tables.
        world().disk.remove(folder / "recording.rrd", missing_ok=True)
        with contextlib.suppress(OSError):  # the disk is full: the streams stay, and can be read
            finish(folder)
    write_summary(folder, summary)
    return summary


def _age_told(folder: Path) -> str:
    """The note on the age of the metrics in the summary that the recorder has written itself; empty if there is none."""
    with contextlib.suppress(UsageError):
        told = re.search(r" \(the metrics are as of [^()]*\)", Results.read(folder).typed_summary.ended)
        return "" if told is None else told[0]
    return ""


def noted(how: str, note: str) -> str:
    """The reason for a run's end, with a note at the end of its first line: an excerpt of a log may follow."""
    first, *excerpt = how.split("\n")
    return "\n".join([first + note, *excerpt])
