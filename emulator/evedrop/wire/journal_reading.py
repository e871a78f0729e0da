"""Reads the journal of a wire that has ended, still runs or was killed.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zenoh

from evedrop.errors import UsageError
from evedrop.model.checks import as_toml
from evedrop.model.slot.link import NEVER
from evedrop.results.wire_summary import JournalState, JournalSummary
from evedrop.system.files import is_locked
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_place import JOURNAL_FOLDER, UNFINISHED, last_beat, parquet_path, part_names, start_of
from evedrop.wire.journal_words import words_in
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import PARQUET, UNLINKED, Kind, Records, WireFate, records_in, records_of, table_of

_LATEST = 1e15  # seconds


def journal_tables(folder: Path | str, start: int | None = None) -> Iterator[pa.Table]:
    """The journal of a wire's folder in the order of its rows, a table for each part.

    The wire may still run, or may have been killed. A journal without messages is one empty table.

    start: only the rows of this start of the wire, from 1; None: the rows of all starts.

    Raises UsageError if there is no journal, or a part cannot be read.
    """
    journal = Path(folder) / JOURNAL_FOLDER
    if not journal.is_dir():
        raise UsageError(
            f"{folder} is not the folder of a wire: it has no folder {JOURNAL_FOLDER}; give the results folder of a wire"
        )
    names = [name for name in part_names(journal) if start in {None, start_of(name)}]
    history = WireHistory.read(journal)  # after the names: a start is in it before its parts are there
    killed = _state(journal, history) == "killed"
    if not names:
        yield PARQUET.empty_table()
    for name in names:
        try:
            yield _table(journal, name, history.links, killed)
        except (OSError, pa.ArrowException) as error:
            raise damaged(journal, name, error) from error


def _state(journal: Path, history: WireHistory) -> JournalState:
    """What became of the latest start."""
    if history.ended:
        return "ended"
    return "running" if is_locked(journal) else "killed"


def _table(journal: Path, name: str, links: dict[int, list[str]], killed: bool) -> pa.Table:
    path, parquet = journal / UNFINISHED / f"{name}.rows", parquet_path(journal, name)
    with contextlib.suppress(FileNotFoundError):  # a running wire may just have made the Parquet file
        if not parquet.exists():
            table = unfinished_table(path, links, killed)
            if not parquet.exists():  # or else the words may be gone already
                return table
    table = pq.read_table(parquet, schema=PARQUET)
    table.validate(full=True)  # a damaged column of words may name words that are not there
    return table


def damaged(journal: Path, name: str, why: object) -> UsageError:
    """The error about a part that cannot be read."""
    return UsageError(
        f"part {name} of the journal in {journal} cannot be read ({why}); remove its file, or give another folder"
    )


def unfinished_table(path: Path, links: Mapping[int, list[str]], killed: bool) -> pa.Table:
    """The records that are not yet in a Parquet file, as a table. Raises OSError, and UsageError if they are damaged.

    links: as in `WireHistory`; killed: as for `records_in`.
    """
    start, records = start_of(path.stem), records_in(path, killed)
    words = words_in(path.parent, start, links.get(start, []))  # after the records: a word is there before its records
    wrong = ~np.isin(records["fate"], [*WireFate]) | ((records["kind"] & 0x7F) > max(Kind)) | (records["n"] >= NEVER)
    wrong |= (records["link"] != UNLINKED) & (records["link"] >= len(words.links))
    for name in ("time", "delay"):
        wrong |= ~(np.abs(records[name]) < _LATEST)  # not a number, too
    if wrong.any():
        raise damaged(path.parents[1], path.stem, f"record {int(wrong.argmax())} is not one of this wire")
    return table_of(records, words)


@final
class JournalOnDisk:
    """The journal of the latest start of a wire."""

    def __init__(self, folder: Path, plan: WirePlan) -> None:
        self.listeners: list[Callable[[Records], None]] = []
        self.amendment_listeners: list[Callable[[Records, WireFate], None]] = []
        self.recorded = 0
        self._folder = folder
        self._links = {link.name: link.number for link in plan.links}
        self.history = WireHistory.read(folder / JOURNAL_FOLDER)
        self.seconds = 0.0
        """Until the wire ended, was last alive, or heard its last message, as far as these were read."""
        self.state = _state(folder / JOURNAL_FOLDER, self.history)
        self._keys = [""]  # code 0 stands for all keys beyond the limit
        self._codes = {"": 0}

    def key_of(self, code: int) -> str:
        """The key of a code."""
        return self._keys[code]

    def read(self) -> None:
        """Hand all records to the listeners. Raises UsageError if there is no journal, or it is damaged."""
        self._is_alive_at(last_beat(self._folder / JOURNAL_FOLDER / UNFINISHED))
        for table in journal_tables(self._folder, self.history.start):
            for key in {*_words_of(table["key"])} - {*self._codes}:
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
        self._is_alive_at(self.history.over)

    @property
    def completeness(self) -> JournalSummary:
        """What an earlier start left behind, and what is not on the disk, if the wire could say so."""
        return self.history.completeness

    def _is_alive_at(self, time: float) -> None:
        self.seconds = max(self.seconds, time - self.history.began)


def _words_of(column: pa.ChunkedArray) -> list[str]:
    """The words that a dictionary column may contain."""
    return [word for chunk in column.chunks for word in chunk.dictionary.to_pylist()]
