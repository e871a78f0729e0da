"""Recovers a journal that an earlier start of the wire left behind, because it was killed or the disk was full.

Source: docs/wire.md, a wire that starts again.
"""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from evedrop.errors import UsageError
from evedrop.system.files import try_lock
from evedrop.wire.history import Numbered, WireHistory, highest
from evedrop.wire.journal_part import write_parquet
from evedrop.wire.journal_reader import UNFINISHED, damaged, last_beat, parquet_path, part_names, unfinished_table
from evedrop.wire.record import Kind


def locked(folder: Path) -> int:
    """The descriptor of a folder that this process alone may use until it closes it. Raises UsageError if another one does."""
    descriptor = os.open(folder, os.O_RDONLY)
    if not try_lock(descriptor):
        os.close(descriptor)
        raise UsageError(f"another wire writes to {folder.parent}; end it, or give another folder")
    return descriptor


def recover(journal: Path, history: WireHistory) -> int:
    """Make Parquet files from all that an earlier start left behind, and end that start; returns the number of such records.

    Raises OSError if the disk is full, and UsageError if a file is damaged; then nothing is lost.
    """
    place = journal / UNFINISHED
    recovered, alive = 0, last_beat(place)
    names = [name for name in part_names(journal) if int(name.partition("-")[0]) == history.start]
    if not history.ended:
        counts = dict(history.counts)
        for name in names:
            path = parquet_path(journal, name)
            try:
                if not path.exists():
                    table = unfinished_table(place / f"{name}.rows", history.links, killed=True)
                    recovered += table.num_rows
                    write_parquet(path, table)
                _count_table(counts, path)
            except (pa.ArrowException, KeyError) as error:
                raise damaged(journal, name, error) from error
        history.end(counts, alive)
    for path in (*journal.glob("*.new"), *place.iterdir()):
        path.unlink()
    return recovered


def _count_table(counts: dict[Numbered, int], path: Path) -> None:
    table = pq.read_table(path, columns=["link", "key", "kind", "n"], filters=pc.field("n").is_valid())
    for row in table.group_by(["link", "key", "kind"]).aggregate([("n", "max")]).to_pylist():
        if row["link"] is None:
            continue
        if row["key"] is None or row["kind"] is None:
            raise pa.ArrowInvalid("a message with a number has no key or no kind")
        highest(counts, (row["link"], row["key"], Kind[row["kind"].upper()].stream), row["n_max"] + 1)
