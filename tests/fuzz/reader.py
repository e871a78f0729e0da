"""A reader of bytes that somebody else made, and how its examples are changed.

A reader gives anything or raises an EvedropError; it is broken by any other error, and by what takes too long.
"""

from __future__ import annotations

import io
import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

from evedrop.errors import EvedropError
from tests.fuzz.mutation import Mutator

Change = Callable[[Mutator, bytes], bytes]


@dataclass(frozen=True)
class Reader:
    """One reader of bytes."""

    examples: Callable[[], list[bytes]]
    read: Callable[[bytes, Path], Any]
    """From the bytes, and a folder of its own, to anything."""
    changes: tuple[Change, ...]
    status: int = 2
    """The exit status of the error that it raises."""
    words: Callable[[], tuple[str, ...]] = tuple

    def changed(self, mutator: Mutator, number: int) -> bytes:
        """An example, changed."""
        examples = self.examples()
        return mutator.random.choice(self.changes)(mutator, examples[number % len(examples)])


def raw(mutator: Mutator, data: bytes) -> bytes:
    """Some of the bytes are others."""
    return mutator.raw(data)


def as_toml(mutator: Mutator, data: bytes) -> bytes:
    """A TOML file with some entries changed."""
    tables = mutator.tree(tomllib.loads(data.decode()))
    try:
        return tomli_w.dumps(tables if isinstance(tables, dict) else {"x": tables}).encode("utf-8", "replace")
    except (TypeError, ValueError, AttributeError):
        return mutator.raw(data)


def as_json(mutator: Mutator, data: bytes) -> bytes:
    """JSON with some values changed."""
    return json.dumps(mutator.tree(json.loads(data))).encode("utf-8", "replace")


def as_msgpack(mutator: Mutator, data: bytes) -> bytes:
    """A packed message with some values changed."""
    try:
        packed: bytes = msgpack.packb(mutator.tree(msgpack.unpackb(data, strict_map_key=False)), use_bin_type=True)
        return packed
    except (OverflowError, TypeError, ValueError):
        return mutator.raw(data)


def cells(mutator: Mutator, data: bytes) -> bytes:
    """A CSV file with some cells or rows changed."""
    rows = [line.split(",") for line in data.decode().split("\n")]
    changed = mutator.tree(rows)
    lines = changed if isinstance(changed, list) else [changed]
    texts = [",".join(map(str, row)) if isinstance(row, list) else str(row) for row in lines]
    return "\n".join(texts).encode("utf-8", "replace")


def as_parquet(mutator: Mutator, data: bytes) -> bytes:
    """A table with some columns of another type, or rows that are not there."""
    table = pq.read_table(io.BytesIO(data))
    rows = mutator.tree(table.to_pylist())
    try:
        return parquet_of(pa.Table.from_pylist(rows, table.schema if mutator.random.random() < 0.7 else None))
    except (pa.ArrowException, TypeError, AttributeError, OverflowError, ValueError):
        return mutator.raw(data)


def lines(mutator: Mutator, data: bytes) -> bytes:
    """Lines of JSON, some of them changed. Zeros may follow them, in a file whose end is mapped into memory."""
    lines = [
        mutator.tree(json.loads(line)) if mutator.random.random() < 0.5 else json.loads(line)
        for line in data.rstrip(b"\0").splitlines()
    ]
    return "".join(f"{json.dumps(line)}\n" for line in lines).encode("utf-8", "replace")


def tried(act: Callable[[], Any]) -> None:
    """Have an error of ours end one thing that is read, and not those after it."""
    try:
        act()
    except EvedropError:
        return


def parquet_of(table: pa.Table) -> bytes:
    """The bytes of a Parquet file."""
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()
