"""Writes the journal of a wire as CSV: what became of every message.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from evedrop.errors import UsageError
from evedrop.wire.journal_reading import journal_tables
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
    first, rows = next(tables), 0  # before a file is made
    try:
        with csv.CSVWriter(file, _PLAIN) as writer:
            for table in chain([first], tables):
                writer.write_table(table.cast(_PLAIN))
                rows += table.num_rows
        return rows
    except OSError as error:
        raise UsageError(f"{file} cannot be written ({error.strerror or error}); give another file") from error
