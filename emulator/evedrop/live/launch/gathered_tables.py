"""Merges the tables of a run's shards, some slots at a time, so that a long run's tables fit into memory.

The rows of each receiver are in order of slots, but the receivers alternate as they did in the run. A merged table has, for
every few thousand slots, one receiver after the other, like the table of an unsharded run that reports that many at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from evedrop.results.folder import private_replacement
from evedrop.results.growing_tables import parquet_or_stream
from evedrop.results.writer import NULLABLE

_BYTES = 4 * 2**20
_ROWS = 65_536


class Gathered(ABC):
    """Merges a table of all shards into that of the run: the base class."""

    def __init__(self, receivers: Sequence[str], row_bytes: float) -> None:
        """receivers: empty for a table without a column of receivers; row_bytes: approximate size of a row."""
        self.receivers = pa.array(receivers)
        self.by = "peer"
        """Name of the column of the receivers."""
        self.slots_at_once = max(1, int(min(_ROWS, _BYTES / row_bytes)) // max(1, len(receivers)))

    def write(self, sources: Sequence[Path], table: Path) -> None:
        """Merge the tables of the shards, in order, and replace the empty table of the run with the result."""
        schema = pq.read_schema(table)
        rows = [_Rows(source, schema, self) for source in sources]
        with (
            private_replacement(table) as unfinished,
            pq.ParquetWriter(unfinished, schema, compression="zstd", compression_level=1) as writer,
        ):
            for first in count(0, self.slots_at_once):
                parts = [one.below(first + self.slots_at_once) for one in rows]
                if not any(part.num_rows for part in parts):
                    break
                writer.write_table(self._one(first, parts, schema))

    def codes(self, table: pa.Table) -> NDArray[np.int64]:
        """The index of the receiver of every row; 0 for a table without receivers."""
        if not len(self.receivers):
            return np.zeros(table.num_rows, np.int64)
        found = pc.index_in(table[self.by].cast(pa.string()), value_set=self.receivers)
        codes: NDArray[np.int64] = found.to_numpy().astype(np.int64)
        return codes

    @abstractmethod
    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        """Merge the rows of the slots from `first` on; parts: the rows of each shard."""

    def _places(self, first: int, part: pa.Table) -> NDArray[np.int64]:
        """The places of the rows in an array with one place for each receiver and slot."""
        slots: NDArray[np.int64] = part["slot"].to_numpy()
        return self.codes(part) * self.slots_at_once + (slots - first)

    def _rows_of(self, first: int, places: NDArray[np.int64], columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
        """The rows of some places, from columns of all places."""
        named = (places // self.slots_at_once).astype(np.int8)
        own = {
            "slot": pa.array(first + places % self.slots_at_once),
            self.by: pa.DictionaryArray.from_arrays(pa.array(named), self.receivers),
        }
        arrays = []
        for one in schema:
            values = own.get(one.name)
            if values is None:
                values = columns[one.name][places]
                values = pa.array(values, one.type, from_pandas=one.name in NULLABLE)
            arrays.append(values)
        return pa.Table.from_arrays(arrays, schema=schema)


@final
class _Rows:
    """A table of one shard, read in order of slots; it ends early if its writer was killed."""

    def __init__(self, path: Path, schema: pa.Schema, gathered: Gathered) -> None:
        self._gathered = gathered
        self._held: pa.Table = schema.empty_table()
        self._reach = np.zeros(max(1, len(gathered.receivers)), np.int64)
        self._batches = parquet_or_stream(path.parent, path.stem, gathered.slots_at_once * len(self._reach))

    def below(self, end: int) -> pa.Table:
        """The rows of all slots below `end` that have not been returned before."""
        parts = [self._held]
        while int(self._reach.min()) < end and (batch := next(self._batches, None)) is not None:
            part = pa.Table.from_batches([batch])
            np.maximum.at(self._reach, self._gathered.codes(part), part["slot"].to_numpy() + 1)
            parts.append(part)
        held = pa.concat_tables(parts)
        due = pc.less(held["slot"], end)
        self._held = held.filter(pc.invert(due))
        return held.filter(due)


@final
class Statistics(Gathered):
    """Merges statistics of slots: means are weighted by the number of trials, and standard errors pooled."""

    # Taken from any shard: theory, which is the same in all, and quantiles, which a live run does not have.
    _TAKEN = ("expected", "error_quantile", "trace_quantile")

    def __init__(self, receivers: Sequence[str]) -> None:
        super().__init__(receivers, 200.0)

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        size = len(self.receivers) * self.slots_at_once
        names = [one.name for one in schema if one.name not in ("slot", self.by, "trials", "standard_error")]
        columns: dict[str, Any] = {name: np.zeros(size) for name in names}
        total, spread = np.zeros(size), np.zeros(size)
        found = [(self._places(first, part), part, part["trials"].to_numpy()) for part in parts]
        for places, part, trials in found:
            total[places] += trials
            for name in names:
                values = part[name].to_numpy()
                if name.startswith(self._TAKEN):
                    columns[name][places] = values
                elif name.endswith("_fraction"):
                    columns[name][places] += np.rint(values * trials)
                else:
                    columns[name][places] += values * trials
        for name in names:
            if not name.startswith(self._TAKEN):
                columns[name] /= total
        for places, part, trials in found:
            inner = np.where(trials > 1, part["standard_error"].to_numpy() ** 2 * trials * (trials - 1.0), 0.0)
            between = part["mean_squared_error"].to_numpy() - columns["mean_squared_error"][places]
            spread[places] += inner + trials * between**2
        columns["standard_error"] = np.where(total > 1, np.sqrt(spread / (total - 1.0) / total), np.nan)
        columns["trials"] = total.astype(np.int64)
        return self._rows_of(first, np.flatnonzero(total), columns, schema)


@final
class Journals(Gathered):
    """Merges journals of slots and links: counts are added, and bit masks concatenated."""

    def __init__(self, receivers: Sequence[str], trials: Sequence[int]) -> None:
        """trials: how many each shard has."""
        super().__init__(receivers, 100.0 + sum(trials))
        self.by = "link"
        self._trials = trials

    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        size = len(self.receivers) * self.slots_at_once
        names = [one.name for one in schema if one.name not in ("slot", self.by, "delivered_mask")]
        columns: dict[str, Any] = {name: np.zeros(size, np.int64) for name in names}
        there, flags = np.zeros(size, np.bool_), np.zeros((size, sum(self._trials)), np.uint8)
        start = 0
        for part, trials in zip(parts, self._trials, strict=True):
            places = self._places(first, part)
            there[places] = True
            for name in names:
                columns[name][places] += part[name].to_numpy()
            masks = np.frombuffer(b"".join(part["delivered_mask"].to_pylist()), np.uint8)
            masks = masks.reshape(len(places), -(-trials // 8))
            flags[places, start : start + trials] = np.unpackbits(masks, axis=1, count=trials, bitorder="little")
            start += trials
        places = np.flatnonzero(there)
        packed = np.packbits(flags[places], axis=1, bitorder="little")
        masks = np.empty(size, object)
        masks[places] = [row.tobytes() for row in packed]
        return self._rows_of(first, places, {**columns, "delivered_mask": masks}, schema)


@final
class Recorded(Gathered):
    """Merges the recorded trials, each in full."""

    def __init__(self, receivers: Sequence[str], trials: range, numbers: int) -> None:
        """trials: the recorded ones; numbers: how many numbers a row has."""
        super().__init__(receivers, len(trials) * 8.0 * numbers)
        self._trials = trials

    def _one(self, first: int, parts: Sequence[pa.Table], schema: pa.Schema) -> pa.Table:
        rows = pa.concat_tables(parts)
        rows = rows.filter(pc.less(rows["trial"], self._trials.stop)).unify_dictionaries().combine_chunks()
        order = np.lexsort((rows["trial"].to_numpy(), self._places(first, rows)))
        return rows.take(pa.array(order)).cast(schema)
