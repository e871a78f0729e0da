"""Recordings of a link: what became of every packet, and if it was measured, how long it took. CSV or Parquet.

Source: docs/links.md, traces.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from emulator.errors import TraceError
from emulator.model.links.trace import MOST_OUTCOMES

Outcomes = NDArray[np.uint8]
"""1 delivered, 0 lost, (packets,)."""

_PARQUET = (".parquet", ".pq")
_EXPECTED = "expected a CSV or Parquet file of 0 (lost) and 1 (delivered)"


class Recording:
    """A recording in a file, read whenever it is asked. Final.

    Raises TraceError for what is no file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if path.exists() and not path.is_file():
            self._no("file", f"is no file; {_EXPECTED}")

    def outcomes(self, column: str | None = None) -> Outcomes:
        """What became of each packet. Raises TraceError, also for anything but 0 and 1, and for more than ten million."""
        found = bytearray()
        for place, value in self._values(column):
            if value not in {"0", "1"}:
                self._no("file", f"{place} is {_shown(value)}; expected 0 (lost) or 1 (delivered)")
            found.append(value == "1")
            if len(found) > MOST_OUTCOMES:
                self._no(
                    "file", f"has more than {MOST_OUTCOMES} outcomes; expected at most so many, such as a part of it"
                )
        if not found:
            self._no("file", f"is empty; {_EXPECTED}")
        return np.frombuffer(bytes(found), np.uint8)

    def delays(self, column: str | None = None) -> NDArray[np.float64]:
        """How long each packet took, in slots, (packets,); NaN where nothing stands. Raises TraceError as `outcomes`."""
        return np.array([self._delay(place, value) for place, value in self._values(column)])

    def _delay(self, place: str, value: str) -> float:
        if not value:
            return math.nan
        try:
            delay = float(value)
        except ValueError:
            delay = -1.0
        if not delay >= 0.0 or math.isinf(delay):
            self._no("file", f"{place} is {_shown(value)}; expected a delay in slots, or nothing for a lost packet")
        return delay

    def columns(self) -> list[str]:
        """Their names; none if the file has no header."""
        try:
            if self._path.suffix.lower() in _PARQUET:
                return list(_parquet(self._path).schema_arrow.names)
            with self._path.open(encoding="utf-8-sig", newline="") as file:
                first = next(_rows(file), (0, []))[1]
            return [] if all(map(_is_number, first)) else first
        except (OSError, ValueError, csv.Error) as error:
            self._unreadable(error)

    def _values(self, column: str | None) -> Iterator[tuple[str, str]]:
        """Where each value of a column stands, and the value as text."""
        try:
            if self._path.suffix.lower() in _PARQUET:
                yield from self._parquet_values(column)
            else:
                yield from self._csv_values(column)
        except (OSError, ValueError, csv.Error) as error:
            self._unreadable(error)

    def _csv_values(self, column: str | None) -> Iterator[tuple[str, str]]:
        with self._path.open(encoding="utf-8-sig", newline="") as file:
            rows = _rows(file)
            number, first = next(rows, (0, []))
            if not first:
                return
            named = column is not None or not all(map(_is_number, first))
            names = first if named else [""] * len(first)
            place = self._place(names, column)
            for line, row in rows if named else chain([(number, first)], rows):
                if len(row) != len(names):
                    self._no(
                        "file", f"line {line} has {len(row)} columns; expected {len(names)}, as the first line has"
                    )
                yield f"line {line}", row[place]

    def _parquet_values(self, column: str | None) -> Iterator[tuple[str, str]]:
        table = _parquet(self._path)
        names = list(table.schema_arrow.names)
        name = names[self._place(names, column)]
        row = 0
        for batch in table.iter_batches(columns=[name]):
            for value in batch.column(0).to_pylist():
                row += 1
                yield f"row {row}", _as_text(value)

    def _place(self, names: Sequence[str], column: str | None) -> int:
        if column is not None:
            if column not in names:
                there = (
                    f"there are {', '.join(names)}"
                    if names and not all(map(_is_number, names))
                    else "there are no names"
                )
                self._no("column", f"{_shown(column)} is no column of {self._path.name}; {there}")
            return names.index(column)
        if len(names) != 1:
            if not any(names):
                self._no(
                    "file", f"has {len(names)} columns without names; expected one column, or a line of names first"
                )
            self._no("column", f'is missing; {self._path.name} has {", ".join(names)}; expected column = "{names[0]}"')
        return 0

    def _unreadable(self, error: Exception) -> NoReturn:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error).splitlines()[0]
        self._no("file", f"cannot be read ({why}); {_EXPECTED}", error)

    def _no(self, entry: str, what: str, cause: Exception | None = None) -> NoReturn:
        raise TraceError(str(self._path), entry, what) from cause


def _rows(file: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank."""
    reader = csv.reader(file)
    for row in reader:
        if row:
            yield reader.line_num, [cell.strip() for cell in row]


def _parquet(path: Path) -> Any:
    import pyarrow.parquet as pq  # noqa: PLC0415 - half a second that a CSV need not wait for

    return pq.ParquetFile(path)


def _as_text(value: Any) -> str:
    """A Parquet value as a CSV file would have it."""
    if value is None:
        return ""
    if isinstance(value, (bool, float)) and value in {0, 1}:
        return str(int(value))
    return str(value)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _shown(value: str) -> str:
    return f'"{value[:40]}{"…" if len(value) > 40 else ""}"' if value else "empty"
