"""Reads the folder of a wire that runs in another process, has ended or was killed: its summary so far.

The closing report has the summary as a table, and sentences below it, as text.

Source: docs/wire/python.md, from Python; docs/wire/results.md, the summary.
"""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

from rich.console import Console

from evedrop.errors import UsageError
from evedrop.results.reading import results_of_this_version
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE, WireSummary
from evedrop.show.report.wire import wire_sentences, wire_table
from evedrop.show.terminal_tables import fitted
from evedrop.system.output import columns_of
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.journal_reading import JournalOnDisk, journal_tables
from evedrop.wire.plan import WirePlan
from evedrop.wire.scorekeeper import WireScorekeeper


def summary_of_wire(folder: Path) -> WireSummary:
    """The summary of a wire; of a wire that runs or was killed, which has none yet, the one that its journal gives.

    Raises UsageError if neither can be read.
    """
    ended = ended_summary(folder)
    return scorekeeper_on_disk(folder, load_wire(folder / WIRE_FILE)).summary() if ended is None else ended


def ended_summary(folder: Path) -> WireSummary | None:
    """The summary that the latest start of a wire wrote when it ended; None if there is none. Raises UsageError.

    That of an earlier start may still be there, because it could not be removed, or because a power cut brought it back.
    """
    path = folder / WIRE_SUMMARY_FILE
    if not path.exists():
        return None
    summary, latest = WireSummary.read(path), 0
    with suppress(UsageError):
        latest = WireHistory.read(folder / JOURNAL_FOLDER).start
    return summary if summary.start >= latest else None


def scorekeeper_on_disk(folder: Path, plan: WirePlan) -> WireScorekeeper:
    """The metrics of a wire so far, from its results folder. Raises UsageError if there is no journal."""
    journal = JournalOnDisk(folder, plan)
    scorekeeper = WireScorekeeper(plan, journal)
    journal.read()
    return scorekeeper


def closing_lines(summary: WireSummary) -> list[str]:
    """The table of the links, as wide as the terminal allows, and the sentences."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=False, width=columns_of(sys.stdout) or _COLUMNS)
    console.print(fitted(wire_table(summary), console))
    return [*(line.rstrip() for line in text.getvalue().splitlines()), *wire_sentences(summary)]


_COLUMNS = 100  # where there is no terminal


def write_wire_report(folder: Path) -> Path:
    """Write the page into a wire's folder, from its summary or else from its journal; returns its path.

    Raises UsageError if neither can be read, and OSError if the page cannot be written.
    """
    from evedrop.show.report.wire_sections import WireSource  # noqa: PLC0415 - templates, which a wire at work does not need
    from evedrop.show.report.writing import wire_page, write_page  # noqa: PLC0415 - as above

    with results_of_this_version(folder):
        summary = summary_of_wire(folder)
        journal = partial(journal_tables, folder, summary.start)
        return write_page(folder, wire_page(WireSource.of(folder, summary, journal)))
