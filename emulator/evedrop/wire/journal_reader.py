"""Reads the journal of a wire: its Parquet files, and the records that are not yet in one.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from evedrop.errors import UsageError
from evedrop.model.slot.link import NEVER
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_part import PARQUET, records_in, table_of
from evedrop.wire.journal_words import words_in
from evedrop.wire.record import UNLINKED, Kind, WireFate

JOURNAL_FOLDER = "journal"
"""The folder inside a wire's folder that contains its journal."""
_LATEST = 1e15  # seconds
UNFINISHED = "unfinished"
"""The folder inside it for records that are not yet in a Parquet file."""


def journal_tables(folder: Path | str, start: int | None = None, killed: bool = False) -> Iterator[pa.Table]:
    """The journal of a wire's folder in the order of its rows, a table for each part.

    The wire may still run, or may have been killed. A journal without messages is one empty table.

    start: only the rows of this start of the wire, from 1; None: the rows of all starts. killed: as for `records_in`.

    Raises UsageError if there is no journal, or a part cannot be read.
    """
    journal = Path(folder) / JOURNAL_FOLDER
    if not journal.is_dir():
        raise UsageError(
            f"{folder} is not the folder of a wire: it has no folder {JOURNAL_FOLDER}; give the results folder of a wire"
        )
    links = WireHistory.read(journal).links
    names = [name for name in part_names(journal) if start in {None, _start_of(name)}]
    if not names:
        yield PARQUET.empty_table()
    for name in names:
        try:
            yield _table(journal, name, links, killed)
        except (OSError, pa.ArrowException) as error:
            raise damaged(journal, name, error) from error


def _table(journal: Path, name: str, links: dict[int, list[str]], killed: bool) -> pa.Table:
    path = journal / UNFINISHED / f"{name}.rows"
    with contextlib.suppress(FileNotFoundError):  # a running wire may just have made the Parquet file
        if not parquet_path(journal, name).exists():
            return unfinished_table(path, links, killed)
    return pq.read_table(parquet_path(journal, name), schema=PARQUET)


def _start_of(name: str) -> int:
    """The number of the start that made a part."""
    return int(name.partition("-")[0])


def damaged(journal: Path, name: str, why: object) -> UsageError:
    """The error about a part that cannot be read."""
    return UsageError(
        f"part {name} of the journal in {journal} cannot be read ({why}); remove its file, or give another folder"
    )


def unfinished_table(path: Path, links: Mapping[int, list[str]], killed: bool) -> pa.Table:
    """The records that are not yet in a Parquet file, as a table. Raises OSError, and UsageError if they are damaged.

    links: as in `WireHistory`; killed: as for `records_in`.
    """
    start = _start_of(path.stem)
    words, records = words_in(path.parent, start, links.get(start, [])), records_in(path, killed)
    wrong = ~np.isin(records["fate"], [*WireFate]) | ((records["kind"] & 0x7F) > max(Kind)) | (records["n"] >= NEVER)
    wrong |= (records["link"] != UNLINKED) & (records["link"] >= len(words.links))
    for name in ("time", "delay"):
        wrong |= ~(np.abs(records[name]) < _LATEST)  # not a number, too
    if wrong.any():
        raise damaged(path.parents[1], path.stem, f"record {int(wrong.argmax())} is not one of this wire")
    return table_of(records, words)


def part_names(journal: Path) -> list[str]:
    """The names of all parts of a journal, such as 001-0002 for the second part of the first start, in order."""
    found = {path.stem for path in (*journal.glob("*.parquet"), *(journal / UNFINISHED).glob("*.rows"))}
    parts = [name for name in found if re.fullmatch(r"\d{3,}-\d{4,}", name)]  # a user may keep files of others there
    return sorted(parts, key=lambda name: [int(number) for number in name.split("-")])


def parquet_path(journal: Path, name: str) -> Path:
    """The Parquet file of a part."""
    return journal / f"{name}.parquet"


def last_beat(unfinished: Path) -> float:
    """The latest time that a wire noted while it ran; 0 if it noted none."""
    with contextlib.suppress(OSError, struct.error):
        beat: float = struct.unpack("<d", (unfinished / "alive").read_bytes())[0]
        return beat
    return 0.0
