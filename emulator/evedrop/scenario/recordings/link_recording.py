"""Recordings of a link: the outcome of every packet and, if it was measured, its delay. CSV or Parquet.

Source: docs/links.md, traces.
"""

from __future__ import annotations

import csv
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Any, NoReturn, final

import numpy as np
from numpy.typing import NDArray

from evedrop.counting import counted
from evedrop.errors import TraceError
from evedrop.model.delays import MOST_DELAYS
from evedrop.model.links.trace import MOST_OUTCOMES
from evedrop.system.files import Limit, Unreadable, lines_of, opened, why_of

Outcomes = NDArray[np.uint8]
"""1 delivered, 0 lost, (packets,)."""

_PARQUET = (".parquet", ".pq")
_EXPECTED = "expected a CSV or Parquet file of 0 (lost) and 1 (delivered), or of delays"
_LIMIT = Limit.of_rows(MOST_OUTCOMES)
_MOST_BYTES = 2**28  # decompressed, of a row group of a Parquet file, whose column is in memory at once
_LONGEST_VALUE = 100  # characters of a text found where a number should be
_MOST_NAMES = 20  # columns that a message lists
_LOOKED_AT = 1000  # values of a column from which a message judges whether it has outcomes
_OUTCOMES = {"0": 0, "1": 1, "false": 0, "true": 1}
_NAMES_OF_LOSSES = {"lost", "loss", "losses", "dropped", "erased", "missing"}
RECEIVED, DELAY = "received", "delay"
"""The columns that are read from a file of several, unless another one is named."""


@final
class LinkRecording:
    """A recording in a file, read on request.

    Raises TraceError if the path is not a file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            opened(path).close()
        except Unreadable as error:
            self._unreadable(error)

    def outcomes(self, column: str | None = None, lost: str | None = None) -> Outcomes:
        """The outcome of each packet. column: where 1 is delivered; lost: instead, the column where 1 is lost.

        Raises TraceError, also for values other than 0 and 1 and for more than ten million, and if the only column is named as
        one of losses and neither argument says what its ones mean.
        """
        if column is not None and lost is not None:
            self._no("lost", "is given together with column; expected one of them", "--lost: leave out --column")
        first_word, zero = ("delivered", "lost") if lost is None else ("lost", "delivered")
        outcomes = bytearray()
        for place, value in self._values(self._column_of_outcomes() if column is lost is None else column or lost):
            outcome = _OUTCOMES.get(value.lower())
            if outcome is None:
                self._no("file", f"{place} is {_shown(value)}; expected 0 ({zero}) or 1 ({first_word})")
            outcomes.append(outcome if lost is None else 1 - outcome)
            if len(outcomes) > MOST_OUTCOMES:
                self._no(
                    "file", f"has more than {MOST_OUTCOMES} outcomes; expected at most that many, such as a part of it"
                )
        if not outcomes:
            self._no("file", f"is empty; {_EXPECTED}")
        return np.frombuffer(bytes(outcomes), np.uint8)

    def delays(self, column: str | None = None) -> NDArray[np.float64]:
        """The delay of each packet in slots, (packets,); NaN for empty values. Raises TraceError as `outcomes` does."""
        delays = []
        for place, value in self._values(self._column_of_delays() if column is None else column):
            delays.append(self._delay(place, value))
            if len(delays) > MOST_DELAYS:
                self._no(
                    "file", f"has more than {MOST_DELAYS} delays; expected at most that many, such as a part of it"
                )
        return np.array(delays)

    def _delay(self, place: str, value: str) -> float:
        if not value:
            return math.nan
        try:
            delay = float(value)
        except ValueError:
            delay = -1.0
        if not delay >= 0.0 or math.isinf(delay):
            self._no("file", f"{place} is {_shown(value)}; expected a delay, or nothing for a lost packet")
        return delay

    def columns(self) -> list[str]:
        """The columns' names; empty if the file has no header."""
        with self._readable():
            if self._is_parquet:
                return list(_parquet(self._path).schema_arrow.names)
            first = next(_rows(lines_of(self._path, _LIMIT)), (0, []))[1]
            return [] if all(map(_is_value, first)) else first

    def _column_of_outcomes(self) -> str | None:
        """The column to read if none is named; None for the only one of a file without names."""
        names = self.columns()
        if not names or RECEIVED in names:
            return RECEIVED if names else None
        others = [name for name in names if name != DELAY] if len(names) == 2 else names
        if len(others) != 1 or _names_losses(others[0]):
            self._ask_for_column(names, others)
        return others[0]

    def _ask_for_column(self, names: Sequence[str], others: Sequence[str]) -> NoReturn:
        """Raise TraceError with a proposal: a column that has outcomes, and both of its meanings if its name is one of losses."""
        typed = f"has {_some(names)}"
        has = f"is missing; {self._path.name} {typed}"
        able = others if len(others) == 1 else [name for name in names[:_MOST_NAMES] if self._may_be_outcomes(name)]
        proposed = min(able, key=_names_losses, default=None)
        if proposed is None:
            none = "none of these has only 0 (lost) and 1 (delivered)"
            self._no(
                "column",
                f"{has}, and {none}; expected a column that has",
                f"{typed}, and {none}; expected one that has",
            )
        entry, option = _shown(proposed), shlex.quote(proposed)
        if _names_losses(proposed):
            self._no(
                "column",
                f"{has}; expected lost = {entry} if 1 means lost there, or column = {entry} if 1 means delivered",
                f"{typed}; expected --lost {option} if 1 means lost there, or --column {option} if 1 means delivered",
            )
        self._no("column", f"{has}; expected column = {entry}", f"{typed}; expected --column {option}")

    def _column_of_delays(self) -> str | None:
        """The column to read if none is named; None for the only one of a file."""
        names = self.columns()
        if len(names) > 1 and DELAY not in names:
            self._no("column", f"is missing; {self._path.name} has {_some(names)}; expected the column of delays")
        return DELAY if len(names) > 1 else None

    def _may_be_outcomes(self, column: str) -> bool:
        """Whether a column begins with outcomes."""
        try:
            values = [value.lower() for _, value in islice(self._values(column), _LOOKED_AT)]
        except TraceError:
            return False
        return bool(values) and all(value in _OUTCOMES for value in values)

    @property
    def _is_parquet(self) -> bool:
        return self._path.suffix.lower() in _PARQUET

    def _values(self, column: str | None) -> Iterator[tuple[str, str]]:
        """The place of each value of a column, and the value as text."""
        with self._readable():
            yield from (self._parquet_values if self._is_parquet else self._csv_values)(column)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Turn errors of reading the file into TraceError."""
        try:
            yield
        except TraceError:
            raise
        except Exception as error:
            # A damaged Parquet file makes pyarrow raise errors of many kinds.
            if not self._is_parquet and not isinstance(error, (Unreadable, csv.Error)):
                raise
            self._unreadable(error)

    def _csv_values(self, column: str | None) -> Iterator[tuple[str, str]]:
        rows = _rows(lines_of(self._path, _LIMIT))
        number, first = next(rows, (0, []))
        if not first:
            return
        named = column is not None or not all(map(_is_value, first))
        names = first if named else [""] * len(first)
        place = self._place(names, column)
        for line, row in rows if named else chain([(number, first)], rows):
            if len(row) != len(names):
                self._no(
                    "file",
                    f"line {line} has {counted(len(row), 'column')}; expected {len(names)}, as the first line has",
                )
            yield f"line {line}", row[place]

    def _parquet_values(self, column: str | None) -> Iterator[tuple[str, str]]:
        table = _parquet(self._path)
        names = list(table.schema_arrow.names)
        place = self._place(names, column)
        if table.schema_arrow.field(place).type.num_fields:
            self._no("file", f"has lists or tables in the column {_shown(names[place])}; {_EXPECTED}")
        # The size of the column alone would do, but Arrow ends the process when it reads that of a malformed file.
        sizes = [table.metadata.row_group(i).total_byte_size for i in range(table.metadata.num_row_groups)]
        if max(sizes, default=0) > _MOST_BYTES:
            large = f"has {max(sizes)} bytes in a row group; expected at most {_MOST_BYTES}"
            self._no(
                "file", f"{large}: write it with fewer rows in a group, or with the column {_shown(names[place])} alone"
            )
        row = 0
        for batch in table.iter_batches(columns=[names[place]]):
            values = batch.column(0)
            # Text values are taken one at a time: every row may contain the same long text.
            repeated = hasattr(values, "dictionary")
            for value in (element.as_py() for element in values) if repeated else values.to_pylist():
                row += 1
                yield f"row {row}", _as_text(value)

    def _place(self, names: Sequence[str], column: str | None) -> int:
        if column is not None:
            if column not in names:
                there = (
                    f"there are {_some(names)}" if names and not all(map(_is_value, names)) else "there are no names"
                )
                self._no("column", f"{_shown(column)} is not a column of {self._path.name}; {there}")
            if names.count(column) > 1:
                self._no(
                    "column", f"{_shown(column)} is the name of {names.count(column)} columns; expected each name once"
                )
            return names.index(column)
        if len(names) != 1:
            self._no(
                "file",
                f"has {counted(len(names), 'column')} without names; expected one column, or a line of names first",
            )
        return 0

    def _unreadable(self, error: Exception) -> NoReturn:
        self._no("file", f"cannot be read ({why_of(error)}); {_EXPECTED}", cause=error)

    def _no(self, entry: str, problem: str, typed: str | None = None, cause: Exception | None = None) -> NoReturn:
        raise TraceError(str(self._path), entry, problem, typed) from cause


def _rows(file: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line. A blank line between others is a gap, one empty cell; all others are left out."""
    reader, begun, blank = csv.reader(file), False, list[int]()
    for row in reader:
        if len(row) < 2 and not any(map(str.strip, row)):
            blank += [reader.line_num] if begun else []
            continue
        yield from ((line, [""]) for line in blank)
        blank, begun = [], True
        yield reader.line_num, [cell.strip() for cell in row]


def _parquet(path: Path) -> Any:
    import pyarrow as pa  # noqa: PLC0415 - takes half a second, which a CSV file does not need
    import pyarrow.parquet as pq  # noqa: PLC0415 - the same

    texts = [
        field.name
        for field in pq.read_schema(path)
        if pa.types.is_string(field.type) or pa.types.is_large_string(field.type)
    ]
    # A text that is repeated in a million rows is kept once.
    return pq.ParquetFile(path, read_dictionary=texts)


def _some(names: Sequence[str]) -> str:
    """The names of columns, in a line of bounded length."""
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(name[:40] for name in names[:_MOST_NAMES]) + more


def _as_text(value: Any) -> str:
    """A Parquet value as a CSV file would contain it."""
    if value is None:
        return ""
    if isinstance(value, (str, bytes)):
        return str(value[:_LONGEST_VALUE])
    if isinstance(value, (bool, float)) and value in {0, 1}:
        return str(int(value))
    return str(value)


def _names_losses(name: str) -> bool:
    """Whether ones in a column of this name are more likely losses than deliveries: lost, packet_loss."""
    return not _NAMES_OF_LOSSES.isdisjoint(re.split(r"[^a-z]+", name.lower()))


def _is_value(cell: str) -> bool:
    """Whether a cell is an outcome or a number, so that its line has no names."""
    if cell.lower() in _OUTCOMES:
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _shown(value: str) -> str:
    return f'"{value[:40]}{"…" if len(value) > 40 else ""}"' if value else "empty"
