"""Tables that grow during a run, in a form that survives any ending, and the Parquet files made from them.

During a run, each table is an Arrow IPC stream in the folder `unfinished` of the results folder, to which record batches
are appended. All tables are written together, in rounds; after each round a line of `unfinished/rounds` states how many
rows each table has. A reader takes the last complete line and that number of rows, so it does not matter at which byte the
writer was killed or the disk became full. When the run ends, the streams become Parquet files, one after the other.

Source: docs/results.md, while a run goes on.
"""

from __future__ import annotations

import contextlib
import errno
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Self, final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xxhash
from numpy.typing import NDArray

from evedrop.results.folder import STATES, UNFINISHED, make_private, replace_private
from evedrop.results.tables import NULLABLE
from evedrop.system.disk import write_all
from evedrop.system.files import LineFile, is_locked, lines_in, try_lock
from evedrop.system.world import world

BATCH_BYTES = 16 * 2**20
"""The largest record batch and row group of a Parquet file, unless a single row is larger."""
_GROUP_ROWS = 32_768
_ROUNDS = "rounds"
_SUMMARY = "summary.json"
_CHECKED_AT_ONCE = 2**20
_LOCK_ATTEMPTS = 50
_LOCKED_SECONDS = 0.002  # in which a reader that looks whether a run goes on holds the lock
_TAIL_BYTES = 65_536  # of the rounds: more than the longest line


@final
class TableStream:
    """An Arrow IPC stream that grows: one table of a run. Rows are held back until the next round."""

    def __init__(self, path: Path, schema: pa.Schema, names: Mapping[str, tuple[str, ...]]) -> None:
        """names: the meaning of the codes of each dictionary column. Raises OSError if the file cannot be created."""
        self.file = path.name
        self.rows = 0
        """Rows on disk."""
        self.held_bytes = 0
        self._schema = schema
        self._names = {column: pa.array(words) for column, words in names.items()}
        self._held: list[list[NDArray[Any]]] = [[] for _ in schema]
        self._held_rows = 0
        self._sink = _Sink(path)
        # Arrow's threads would cost more than they save: the batches are small, and other processes need the cores.
        options = pa.ipc.IpcWriteOptions(compression="lz4", use_threads=False)
        self._writer = pa.ipc.new_stream(pa.PythonFile(self._sink, mode="w"), schema, options=options)
        # Arrow writes the schema with the first batch, and a reader needs the schema before there are rows.
        empty = [
            pa.DictionaryArray.from_arrays(pa.array([], pa.int8()), self._names[field.name])
            if field.name in self._names
            else pa.array([], field.type)
            for field in schema
        ]
        self._writer.write_batch(pa.RecordBatch.from_arrays(empty, schema=schema))

    def add(self, columns: Sequence[NDArray[Any]]) -> int:
        """Hold back rows until the next round; returns their size in bytes.

        columns: an array for each column: codes for dictionary columns, two-dimensional for lists or bytes.
        """
        # Copies, because a view would keep a whole message in memory.
        copies = [np.array(column) for column in columns]
        for held, column in zip(self._held, copies, strict=True):
            held.append(column)
        self._held_rows += len(columns[0])
        size = sum(column.nbytes for column in copies)
        self.held_bytes += size
        return size

    def write(self) -> None:
        """Write the rows held back to the file. Raises OSError if they cannot be written completely."""
        if self._held_rows:
            whole = [np.concatenate(held) for held in self._held]
            at_once = max(1, self._held_rows * BATCH_BYTES // max(1, self.held_bytes))
            for first in range(0, self._held_rows, at_once):
                columns = [
                    self._column(column, values[first : first + at_once])
                    for column, values in zip(self._schema, whole, strict=True)
                ]
                self._writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=self._schema))
                self._sink.flush()
        self._sink.flush()
        self.rows += self._held_rows
        self._held, self._held_rows, self.held_bytes = [[] for _ in self._schema], 0, 0

    def _column(self, column: pa.Field, values: NDArray[Any]) -> pa.Array:
        if column.name in self._names:
            return pa.DictionaryArray.from_arrays(pa.array(values.astype(np.int8)), self._names[column.name])
        if pa.types.is_fixed_size_list(column.type):
            return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if pa.types.is_fixed_size_binary(column.type):
            return pa.FixedSizeBinaryArray.from_buffers(column.type, len(values), [None, pa.py_buffer(values)])
        if pa.types.is_binary(column.type):
            ends = np.arange(len(values) + 1, dtype=np.int32) * np.int32(values.shape[1])
            return pa.BinaryArray.from_buffers(
                column.type, len(values), [None, pa.py_buffer(ends), pa.py_buffer(values)]
            )
        return pa.array(values, column.type, from_pandas=column.name in NULLABLE)

    @property
    def end(self) -> tuple[str, int, int, int]:
        """Its file, rows on disk, bytes on disk, and a checksum of these."""
        return self.file, self.rows, self._sink.size, self._sink.check

    def close(self) -> None:
        """Close the file; rows held back are dropped."""
        self._sink.close()


@final
class _Sink:
    """A file for Arrow that writes every byte or raises: Arrow does not notice a short write."""

    def __init__(self, path: Path) -> None:
        self._file = world().disk.open(path, "xb")
        self._waiting: list[bytes] = []
        self.closed = False
        self.size = 0
        self._check = xxhash.xxh3_64()

    def write(self, data: Any) -> int:
        self._waiting.append(bytes(data))
        return len(self._waiting[-1])

    def flush(self) -> None:
        data, self._waiting = b"".join(self._waiting), []
        write_all(self._file, data)
        self.size += len(data)
        self._check.update(data)

    @property
    def check(self) -> int:
        """A checksum of all that is on disk."""
        return self._check.intdigest()

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._file.close()


@dataclass(frozen=True)
class TableRound:
    """The part of an unfinished results folder that is on disk."""

    at: str = ""
    """How far the run came, in words."""
    slots: int = 0
    """The number of slots that have rows."""
    tables: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    """Table → its file and its number of valid rows."""
    checks: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Table → the number of bytes of its file that have these rows, and a checksum of these bytes."""

    @classmethod
    def read(cls, line: bytes) -> Self:
        """Read a line of the rounds. Raises an error if it is damaged."""
        entry = json.loads(line)
        tables, checks = {}, {}
        for name, (file, rows, *check) in entry["tables"].items():
            if not _STREAM_FILE.fullmatch(file):
                raise ValueError(f"{file!r} is not the name of a stream")
            tables[str(name)] = (file, int(rows))
            if check:  # an older version wrote none
                size, checksum = check
                checks[str(name)] = (int(size), int(checksum))
        return cls(str(entry["at"]), int(entry["slots"]), tables, checks)

    def survives(self, folder: Path, checksums: Mapping[str, Mapping[int, int] | None]) -> bool:
        """Whether a power cut has left all of it in a results folder; checksums: those of its files, see `_checksums_of`."""
        for name, (size, checksum) in self.checks.items():
            of_file = checksums[self.tables[name][0]]
            if of_file is None:
                if not (folder / f"{name}.parquet").exists():
                    return False
            elif of_file.get(size) != checksum:
                return False
        return True


_STREAM_FILE = re.compile(r"[a-z]+-[0-9]+\.arrows")


def stream_file(name: str, number: int) -> str:
    """The file of a table's stream; a stream that replaces another has the next number."""
    return f"{name}-{number}.arrows"


def _checksums_of(folder: Path, rounds: Sequence[TableRound]) -> dict[str, Mapping[int, int] | None]:
    """File → size that one of these rounds gives → checksum of so many bytes at its beginning; None if there is no such file.

    Each file is read once. A size is left out if the file is shorter.
    """
    sizes: dict[str, set[int]] = {}
    for latest in rounds:
        for name, (size, _) in latest.checks.items():
            sizes.setdefault(latest.tables[name][0], set()).add(size)
    checksums: dict[str, Mapping[int, int] | None] = {}
    for file, wanted in sizes.items():
        path = folder / UNFINISHED / file
        try:
            status = path.stat()
        except OSError:
            checksums[file] = None
        else:
            state = (status.st_ino, status.st_size, status.st_mtime_ns)
            checksums[file] = _checksums(path, tuple(sorted(wanted)), state)
    return checksums


@lru_cache(maxsize=64)
def _checksums(path: Path, sizes: tuple[int, ...], state: tuple[int, ...]) -> Mapping[int, int]:
    """Size, in rising order → checksum of so many bytes of a file. state: something that changes with the file."""
    del state
    check, done = xxhash.xxh3_64(), 0
    checksums = {}
    with contextlib.suppress(OSError), path.open("rb") as file:
        for size in sizes:
            while done < size and (data := file.read(min(size - done, _CHECKED_AT_ONCE))):
                done += len(data)
                check.update(data)
            if done < size:
                break
            checksums[size] = check.intdigest()
    return checksums


class Unfinished:
    """The writer's side of the folder `unfinished`. Holds a lock on it, which tells readers that the run is in progress."""

    def __init__(self, folder: Path) -> None:
        """Create the folder in a results folder. Raises OSError on failure."""
        place = folder / UNFINISHED
        make_private(place, exist_ok=False)
        self._descriptor = world().disk.hold(place)
        for _ in range(_LOCK_ATTEMPTS):  # on a file system without locks, a run in progress looks killed
            if try_lock(self._descriptor):
                break
            world().sleep(_LOCKED_SECONDS)
        self._rounds = LineFile(place / _ROUNDS)

    def round(
        self, at: str, slots: int, streams: Mapping[str, TableStream], before: Callable[[], None] = lambda: None
    ) -> None:
        """Write the rows that all streams hold back, call `before`, and write the line that makes the rows count.

        Raises OSError on failure.
        """
        for stream in streams.values():
            stream.write()
        before()
        tables = {name: stream.end for name, stream in streams.items()}
        self._rounds.append({"at": at, "slots": slots, "tables": tables})

    def close(self) -> None:
        """Release the lock; the files stay."""
        self._rounds.close()
        world().disk.let_go(self._descriptor)


def is_unfinished(folder: Path) -> bool:
    """Whether a results folder has tables that are not yet Parquet files."""
    return (folder / UNFINISHED).is_dir()


def goes_on(folder: Path) -> bool:
    """Whether a process still writes to an unfinished results folder."""
    return is_locked(folder / UNFINISHED)


def last_round(folder: Path) -> TableRound:
    """The last round that was written completely; empty if there was none.

    A power cut may leave the line of a round and not its rows, so such a round counts only if its rows are on the disk, unless
    its writer still runs.
    """
    runs = goes_on(folder)
    for last in (_TAIL_BYTES, None):  # a power cut may have taken more rounds than there are at the end
        rounds = _rounds(folder, last)
        latest = next(rounds if runs else _surviving(folder, [*rounds]), None)
        if latest is not None:
            return latest
    return TableRound()


def _rounds(folder: Path, last: int | None) -> Iterator[TableRound]:
    """The rounds that were written completely, from the last one on; last: as in `lines_in`."""
    with contextlib.suppress(OSError):
        for line in reversed(lines_in(folder / UNFINISHED / _ROUNDS, last)):
            with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, OverflowError):
                yield TableRound.read(line)


def _surviving(folder: Path, rounds: Sequence[TableRound]) -> Iterator[TableRound]:
    """Those of some rounds that a power cut has left."""
    checksums = _checksums_of(folder, rounds)
    return (each for each in rounds if each.survives(folder, checksums))


def write_metrics(folder: Path, text: str) -> None:
    """Write the summary of the run so far; the file is complete at any moment."""
    replace_private(folder / UNFINISHED / _SUMMARY, text)


def metrics_path(folder: Path) -> Path:
    """The path to which `write_metrics` writes."""
    return folder / UNFINISHED / _SUMMARY


def keep(folder: Path) -> TableRound:
    """Let a power cut leave all rows that count, and the states that they are of; returns their round. Raises OSError."""
    latest = last_round(folder)
    files = [folder / UNFINISHED / file for file in (*(file for file, _ in latest.tables.values()), _ROUNDS)]
    if (folder / STATES).exists():
        files.insert(0, folder / STATES)
    for file in files:
        with contextlib.suppress(FileNotFoundError):  # of a table that is a Parquet file already
            world().disk.sync(file)
    return latest


@contextlib.contextmanager
def stream_of(folder: Path, name: str) -> Iterator[tuple[pa.Schema, Iterator[pa.RecordBatch]] | None]:
    """The schema of a table in a stream, and its rows, batch by batch: fewer if it is damaged.

    None if there is no such stream: then the table is a Parquet file, or there is none. Schema and rows are of one file, even
    if its table becomes a Parquet file meanwhile.
    """
    whole = (folder / f"{name}.parquet").exists()
    file, rows = ("", 0) if whole else last_round(folder).tables.get(name, ("", 0))
    with contextlib.ExitStack() as opened:
        reader = None
        if file:
            with contextlib.suppress(OSError, pa.ArrowException):
                reader = opened.enter_context(_stream_in(folder, file))
        yield None if reader is None else (reader.schema, _batches_in(reader, rows))


@contextlib.contextmanager
def _stream_in(folder: Path, file: str) -> Iterator[pa.RecordBatchStreamReader]:
    """The stream in a file of the folder `unfinished`. Raises OSError or an error of Arrow."""
    options = pa.ipc.IpcReadOptions(use_threads=False)
    with (
        pa.OSFile(str(folder / UNFINISHED / file)) as source,
        pa.ipc.open_stream(source, options=options) as reader,
    ):
        yield reader


def _batches_in(reader: pa.RecordBatchStreamReader, rows: int) -> Iterator[pa.RecordBatch]:
    """The first rows of a stream, batch by batch; fewer if it is damaged."""
    with contextlib.suppress(OSError, pa.ArrowException, StopIteration):
        while rows > 0:
            batch = reader.read_next_batch()
            yield batch.slice(0, rows)
            rows -= batch.num_rows


def schema_of(folder: Path, name: str) -> pa.Schema | None:
    """The schema of a table in a stream; None if there is no such stream."""
    with stream_of(folder, name) as stream:
        return None if stream is None else stream[0]


def parquet_or_stream(folder: Path, name: str, rows: int = _GROUP_ROWS) -> Iterator[pa.RecordBatch]:
    """The rows of a table, `rows` at a time if it is a Parquet file; none if there is no such table or it is damaged."""
    with stream_of(folder, name) as stream, contextlib.suppress(OSError, pa.ArrowException):
        yield from parquet_batches(folder / f"{name}.parquet", rows) if stream is None else stream[1]


def parquet_batches(path: Path, rows: int, columns: Sequence[str] | None = None) -> Iterator[pa.RecordBatch]:
    """The rows of a Parquet file, `rows` at a time, with all columns or these. Memory: one row group.

    Raises OSError or an error of Arrow if the file is damaged, KeyError if it lacks a column.
    """
    # By default Arrow reads all row groups ahead and keeps them; each of its threads would keep memory, too.
    with pq.ParquetFile(path, pre_buffer=False) as file:
        if columns is not None:  # `iter_batches` passes over columns that are not there, and this raises an error
            file.schema_arrow.empty_table().select(columns)
        for batch in file.iter_batches(rows, columns=columns, use_threads=False):
            yield batch
            pa.default_memory_pool().release_unused()


def finish(folder: Path) -> None:
    """Turn all streams into Parquet files; each stream is removed when its file is complete. Memory: one row group.

    Raises OSError if a file cannot be written: its table and all later ones stay streams, which can be read as well.
    """
    # Without `keep`, a power cut would leave some tables whole, and of the others what had reached the disk by itself.
    for name, (file, rows) in keep(folder).tables.items():
        with contextlib.ExitStack() as opened:
            try:
                reader = opened.enter_context(_stream_in(folder, file))
            except (OSError, pa.ArrowException):
                continue
            _write_parquet(folder, name, reader, rows)
        world().disk.remove(folder / UNFINISHED / file)


def _write_parquet(folder: Path, name: str, reader: pa.RecordBatchStreamReader, rows: int) -> None:
    """Turn the first rows of a stream into the Parquet file of a table. Raises OSError or an error of Arrow.

    It is an error if the stream has fewer rows.
    """
    unfinished = folder / UNFINISHED / f"{name}.parquet"
    left = rows
    try:
        with parquet_writer(unfinished, reader.schema) as writer:
            for group in _groups(_batches_in(reader, rows)):
                writer.write_table(pa.Table.from_batches(group, reader.schema).combine_chunks())
                left -= sum(batch.num_rows for batch in group)
        if left:
            raise OSError(errno.EIO, f"{left} of {rows} rows of {name} cannot be read")
    except (OSError, pa.ArrowException):
        world().disk.remove(unfinished, missing_ok=True)
        raise
    world().disk.sync(unfinished)
    world().disk.replace(unfinished, folder / f"{name}.parquet")


@contextlib.contextmanager
def parquet_writer(path: Path, schema: pa.Schema) -> Iterator[pq.ParquetWriter]:
    """Write a Parquet file that only this user can read. Raises OSError."""
    # A dictionary of numbers, most of which differ, takes longer to make, and more room.
    names = [column.name for column in schema if pa.types.is_dictionary(column.type)]
    with (
        world().disk.writer(path) as file,
        pq.ParquetWriter(file, schema, compression="zstd", compression_level=1, use_dictionary=names) as writer,
    ):
        yield writer


def _groups(batches: Iterator[pa.RecordBatch]) -> Iterator[list[pa.RecordBatch]]:
    """Batches grouped into row groups."""
    held: list[pa.RecordBatch] = []
    rows = size = 0
    for batch in batches:
        if not batch.num_rows:
            continue
        if held and size + batch.nbytes > BATCH_BYTES:
            yield held
            held, rows, size = [], 0, 0
        held.append(batch)
        rows, size = rows + batch.num_rows, size + batch.nbytes
        if rows >= _GROUP_ROWS:
            yield held
            held, rows, size = [], 0, 0
    if held:
        yield held


def forget(folder: Path) -> None:
    """Remove the folder `unfinished` if all its tables are Parquet files. Call this after the summary is written."""
    if not any((folder / UNFINISHED / file).exists() for file, _ in last_round(folder).tables.values()):
        world().disk.remove_tree(folder / UNFINISHED, ignore_errors=True)
