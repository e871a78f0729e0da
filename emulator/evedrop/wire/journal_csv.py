"""Writes the journal of a wire as CSV: what became of every message.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from evedrop.errors import UsageError
from evedrop.wire.journal import journal_tables
from evedrop.wire.records import PARQUET

_PLAIN = pa.schema(
    [
        pa.field(field.name, field.type.value_type if pa.types.is_dictionary(field.type) else field.type)
        for field in PARQUET
    ]
)


def write_journal_csv(folder: Path, file: Path) -> int:
    """Write a row for each message and link, part by part; returns their number.

    Raises UsageError if the folder has no journal, or one that cannot be read, or the file cannot be written.
    """
    tables = journal_tables(folder)
    rows: int = 0
    table = next(tables)  # before a file is made
    try:
        with csv.CSVWriter(file, _PLAIN) as writer:
            while True:
                writer.write_table(table.cast(_PLAIN))
                rows += table.num_rows
                following = next(tables, None)
                if following is None:
                    return rows
                table = following
    except OSError as error:
        raise UsageError(f"{file} cannot be written ({error.strerror or error}); give another file") from error
