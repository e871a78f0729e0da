"""Reads the folder of a wire that runs in another process, has ended or was killed: its summary so far.

The closing report has the summary as a table, and sentences below it, as text.

Source: docs/wire.md, from Python, and the summary.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import final

import pyarrow as pa
import zenoh
from rich.console import Console

from evedrop.errors import UsageError
from evedrop.model.checks import as_toml
from evedrop.results.reading import results_of_this_version
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE, JournalState, JournalSummary, WireSummary
from evedrop.show.report.wire import wire_sentences, wire_table
from evedrop.show.terminal_tables import rich_table
from evedrop.system.files import is_locked
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal import JOURNAL_FOLDER, UNFINISHED, AmendmentListener, Listener, journal_tables, last_beat
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import records_of
from evedrop.wire.scorekeeper import WireScorekeeper


def summary_of_wire(folder: Path) -> WireSummary:
    """The summary of a wire; of a wire that runs or was killed, which has none yet, the one that its journal gives.

    Raises UsageError if neither can be read.
    """
    path = folder / WIRE_SUMMARY_FILE
    if path.exists():
        return WireSummary.read(path)
    return scorekeeper_on_disk(folder, load_wire(folder / WIRE_FILE)).summary()


def scorekeeper_on_disk(folder: Path, plan: WirePlan) -> WireScorekeeper:
    """The metrics of a wire so far, from its results folder. Raises UsageError if there is no journal."""
    journal = JournalOnDisk(folder, plan)
    scorekeeper = WireScorekeeper(plan, journal)
    journal.read()
    return scorekeeper


@final
class JournalOnDisk:
    """The journal of the latest start of a wire."""

    def __init__(self, folder: Path, plan: WirePlan) -> None:
        self.listeners: list[Listener] = []
        self.amendment_listeners: list[AmendmentListener] = []
        self.recorded = 0
        self.completeness = JournalSummary(0, 0, None)
        self._folder = folder
        self._links = {link.name: link.number for link in plan.links}
        self.history = WireHistory.read(folder / JOURNAL_FOLDER)
        self.seconds = 0.0
        """Until the wire was last alive, or heard its last message, as far as these were read."""
        self.state: JournalState = "ended"
        if not self.history.ended:
            self.state = "running" if is_locked(folder / JOURNAL_FOLDER) else "killed"
        self._keys = [""]  # code 0 stands for all keys beyond the limit
        self._codes = {"": 0}

    def key_of(self, code: int) -> str:
        """The key of a code."""
        return self._keys[code]

    def read(self) -> None:
        """Hand all records to the listeners. Raises UsageError if there is no journal, or it is damaged."""
        self._is_alive_at(last_beat(self._folder / JOURNAL_FOLDER / UNFINISHED))
        for table in journal_tables(self._folder, self.history.start, killed=self.state == "killed"):
            for key in {*_words(table["key"])} - {*self._codes}:
                try:
                    zenoh.KeyExpr(key)
                except zenoh.ZError as error:
                    raise UsageError(
                        f"the journal in {self._folder} is damaged: {as_toml(key)} is not a key; remove the journal, or give "
                        "another folder"
                    ) from error
                self._codes[key] = len(self._keys)
                self._keys.append(key)
            records = records_of(table, self._links, self._codes)
            self.recorded += len(records)
            if len(records):
                self._is_alive_at(float(records["time"].max()))
                for listener in self.listeners:
                    listener(records)
        # Again, because a change may have come in between; it is written before the first record that it concerns.
        self.history = WireHistory.read(self._folder / JOURNAL_FOLDER)
        self.history.expect_settings()

    def _is_alive_at(self, time: float) -> None:
        self.seconds = max(self.seconds, time - self.history.began)


def _words(column: pa.ChunkedArray) -> list[str]:
    """The words that a dictionary column may contain."""
    return [word for chunk in column.chunks for word in chunk.dictionary.to_pylist()]


def closing_lines(summary: WireSummary) -> list[str]:
    """The table of the links, and the sentences."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=False, width=max(100, shutil.get_terminal_size().columns))
    console.print(rich_table(wire_table(summary)))
    return [*(line.rstrip() for line in text.getvalue().splitlines()), *wire_sentences(summary)]


def write_wire_report(folder: Path) -> Path:
    """Write the page into a wire's folder, from its summary or else from its journal; returns its path.

    Raises UsageError if neither can be read, and OSError if the page cannot be written.
    """
    from evedrop.show.report.wire_sections import WireSource  # noqa: PLC0415 - templates, which a wire at work does not need
    from evedrop.show.report.writing import wire_page, write_page  # noqa: PLC0415 - as above

    with results_of_this_version(folder):
        return write_page(folder, wire_page(WireSource.of(folder, summary_of_wire(folder))))
