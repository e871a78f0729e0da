"""The journal of a wire that runs in another process, read from the disk: for its figures so far.

Source: docs/wire.md, from Python.
"""

from __future__ import annotations

from pathlib import Path
from typing import final

import pyarrow as pa

from evedrop.model.slot.link import Change
from evedrop.wire.history import WireHistory
from evedrop.wire.journal import AmendmentListener, Listener
from evedrop.wire.journal_part import records_of
from evedrop.wire.journal_reader import JOURNAL_FOLDER, journal_tables
from evedrop.wire.plan import WirePlan
from evedrop.wire.summary import WireSummary


def summary_on_disk(folder: Path, plan: WirePlan) -> WireSummary:
    """The summary of a wire so far, from its results folder. Raises UsageError if there is no journal."""
    journal = JournalOnDisk(folder, plan)
    summary = WireSummary(plan, journal)
    journal.read()
    return summary


@final
class JournalOnDisk:
    """The journal of the latest start of a wire."""

    def __init__(self, folder: Path, plan: WirePlan) -> None:
        self.listeners: list[Listener] = []
        self.amendment_listeners: list[AmendmentListener] = []
        self.recorded = self.recovered = self.missing = 0
        self.incomplete_since: float | None = None
        self._folder = folder
        self._links = {link.name: link.number for link in plan.links}
        self._history = WireHistory.read(folder / JOURNAL_FOLDER)
        self._keys: list[str] = []
        self._codes: dict[str, int] = {}

    @property
    def start(self) -> int:
        """The number of the start, from 1."""
        return self._history.start

    @property
    def events(self) -> list[tuple[float, str]]:
        """The events of the start: seconds since it began, and a line for each."""
        return self._history.events

    def key_of(self, code: int) -> str:
        """The key of a code."""
        return self._keys[code]

    def changes_of(self, link: str, key: str, kind: str) -> tuple[Change, ...]:
        """The settings that the messages of a stream had, from message 0 on."""
        return self._history.changes_of(link, key, kind)

    def read(self) -> None:
        """Hand all records to the listeners. Raises UsageError if there is no journal."""
        for table in journal_tables(self._folder, self.start):
            for key in {*_words(table["key"])} - {*self._codes}:
                self._codes[key] = len(self._keys)
                self._keys.append(key)
            records = records_of(table, self._links, self._codes)
            self.recorded += len(records)
            for listener in self.listeners if len(records) else ():
                listener(records)


def _words(column: pa.ChunkedArray) -> list[str]:
    """The words that a dictionary column may contain."""
    return [word for chunk in column.chunks for word in chunk.dictionary.to_pylist()]
