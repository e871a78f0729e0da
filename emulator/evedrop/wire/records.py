"""The records of a wire's journal: a row for each message and link, made when its fate is known, and the files that have them.

Records are written into a file that is mapped into memory, so they survive the end of the process at any instruction; a Parquet
file is made from it later. Its place on the disk is taken when it is made, so a full disk cannot end the process later. The last
byte of a record, which is written last, is its fate + 1: a record whose last byte is 0 is not whole. Its highest bit is set
until a message that is to be delivered has been delivered.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from evedrop.model.links.loss_model import Fate
from evedrop.results.crash_proof_tables import parquet_writer
from evedrop.results.folder import private_replacement
from evedrop.system.world import world


class WireFate(IntEnum):
    """The outcome of a message on a link. Up to `CUT` as `Fate`; the rest is not emulated but happens to the wire itself."""

    DELIVERED = Fate.DELIVERED
    """Given to Zenoh on the other side."""
    LOST = Fate.LOST
    """Erased by the link's loss model."""
    CORRUPTED = Fate.CORRUPTED
    """Damaged on the way, as a checksum would show."""
    OVERFLOW = Fate.OVERFLOW
    """The emulated queue before a link of limited rate was full."""
    CUT = Fate.CUT
    """The link was cut, or its sides were partitioned."""
    UNLINKED = 16
    """No link of the file takes its key between these sides."""
    TOO_LARGE = 17
    """Larger than `WirePlan.largest`."""
    HELD_UP = 18
    """The wire already held as many delayed messages as it may."""
    LOOPED = 19
    """A router outside the wire joins both sides, so the message would go round."""
    UNDERWAY = 20
    """Still delayed, or waiting for the wire, when it ended."""
    REFUSED = 21
    """Zenoh raised an error when the message was put on the other side."""
    TOO_MANY_KEYS = 22
    """Its key is new, and the programs of its side have already used as many keys as a wire keeps."""
    CONGESTED = 23
    """The other side no longer took messages, or too slowly, and the wire already kept as many for it as it may."""

    @property
    def emulated(self) -> bool:
        """Whether a link's settings decide this outcome."""
        return self <= WireFate.CUT

    @property
    def decided(self) -> bool:
        """Whether the loss and corruption models of a link decided on such a message, and how is known."""
        return self.passed or self in {WireFate.LOST, WireFate.CORRUPTED}

    @property
    def passed(self) -> bool:
        """Whether these models let such a message pass."""
        return self in {WireFate.DELIVERED, WireFate.HELD_UP, WireFate.UNDERWAY, WireFate.REFUSED, WireFate.CONGESTED}


class Kind(IntEnum):
    """What a message is."""

    PUT = 0
    DELETE = 1
    QUERY = 2
    REPLY = 3

    @property
    def stream(self) -> str:
        """The kind of messages with which it shares its numbers and random streams: a delete is numbered as a put."""
        return "put" if self is Kind.DELETE else self.name.lower()


AGAIN = 0x80
"""Added to the kind in the record of a message that was delivered twice, if it was delivered at all."""

HELD = 0x80
"""Added to the fate in the record of a message that will be delivered, until Zenoh has taken it."""

UNLINKED = 2**16 - 1
"""The code of a link in the record of a message that no link takes."""

RECORD = np.dtype(
    [
        ("time", "<f8"),  # seconds since 1970, when the wire heard it
        ("n", "<i8"),  # its number among the messages of its key and kind on its link, from 0; -1 if it has none
        ("sequence", "<i8"),  # its sender's own number for it; -1 if it has none
        ("delay", "<f8"),  # seconds that the link holds it back, its queue included
        ("key", "<u4"),  # code of the key; 0 if it is not kept, `WireFate.TOO_MANY_KEYS`
        ("source", "<u4"),  # code of the sender; 0 if it is not known
        ("size", "<u4"),  # bytes of payload and attachment
        ("link", "<u2"),  # code of the link
        ("kind", "u1"),  # `Kind`, with `AGAIN`
        ("fate", "u1"),  # `WireFate`, with `HELD`
    ]
)
"""A row of the journal while the wire runs, 48 bytes; codes of keys and sources are in another file."""


def next_numbers(block: NDArray[Any]) -> Iterator[tuple[int, int, Kind, int]]:
    """The codes of link and key, the kind, and the number after the last message, for each stream of a block of `RECORD`s."""
    rows = block[(block["n"] >= 0) & (block["link"] != UNLINKED)]
    link, key, kind = (rows[name].astype(np.uint64) for name in ("link", "key", "kind"))
    streams = link << np.uint64(40) | key << np.uint64(8) | kind & np.uint64(0x7F)
    distinct, places = np.unique(streams, return_inverse=True)
    numbers = np.zeros(len(distinct), np.int64)
    np.maximum.at(numbers, places, rows["n"] + 1)
    for stream, n in zip(distinct.tolist(), numbers.tolist(), strict=True):
        yield stream >> 40, stream >> 8 & 0xFFFF_FFFF, Kind(stream & 0xFF), n


Records = NDArray[Any]
"""Structured, of the type `RECORD`."""
STORED = 1
"""Added to fates in memory and in files of records."""

REASONS: dict[WireFate, str] = {
    fate: "loss" if fate is WireFate.LOST else fate.name.lower() for fate in WireFate if fate is not WireFate.DELIVERED
}
"""The reason for each fate, as it is called in tables."""
_FATES = {reason: int(fate) for fate, reason in REASONS.items()}
_WORDS = ("delivered", "lost", "dropped")


def word_of(fate: WireFate) -> str:
    """`delivered`, `lost` by the emulated link, or `dropped` by the wire itself."""
    return _WORDS[0] if fate is WireFate.DELIVERED else _WORDS[1] if fate.emulated else _WORDS[2]


_WORD_CODES = np.zeros(256, np.int8)
_REASON_CODES = np.zeros(256, np.int8)
for _at, _fate in enumerate(REASONS):
    _WORD_CODES[_fate], _REASON_CODES[_fate] = _WORDS.index(word_of(_fate)), _at
_KINDS = {one.name.lower(): int(one) for one in Kind}

PARQUET = pa.schema(
    [
        ("time", pa.float64()),
        ("link", pa.dictionary(pa.int32(), pa.string())),
        ("key", pa.dictionary(pa.int32(), pa.string())),
        ("size", pa.int64()),
        ("source", pa.dictionary(pa.int32(), pa.string())),
        ("sequence", pa.int64()),
        ("fate", pa.dictionary(pa.int8(), pa.string())),
        ("reason", pa.dictionary(pa.int8(), pa.string())),
        ("delay", pa.float64()),
        ("n", pa.int64()),
        ("kind", pa.dictionary(pa.int8(), pa.string())),
        ("again", pa.bool_()),
    ]
)
"""The columns of a Parquet file of the journal."""


@dataclass(frozen=True)
class Words:
    """What the codes in records stand for."""

    links: Sequence[str]
    keys: dict[int, str]
    sources: dict[int, str]


_AHEAD = 512  # rows that are looked at together for the first that is not whole: most of a part is empty for long


@final
class JournalPart:
    """Records in a file, or in memory alone if the disk is full."""

    def __init__(self, path: Path | None, rows: int) -> None:
        """path: of a new file for this number of rows. Raises OSError if the disk has no room for all of them."""
        self.path = path
        size = rows * RECORD.itemsize
        if path is None:
            self.buffer = mmap.mmap(-1, size)
        else:
            self.buffer = _mapped(path, size)
        self._stored: Records = np.frombuffer(self.buffer, RECORD)
        self.handed = 0
        """The number of rows that were handed to the listeners."""

    def take(self) -> Records:
        """A copy of the rows that are whole and were not taken yet, up to the first that is not whole."""
        fates, stop = self._stored["fate"], self.handed
        while len(ahead := fates[stop : stop + _AHEAD]) and ahead.all():
            stop += len(ahead)
        if len(ahead):
            stop += int(ahead.argmin())
        if stop == self.handed:
            return np.empty(0, RECORD)
        rows = _whole(self._stored[self.handed : stop])
        self.handed += len(rows)
        return rows

    def whole(self) -> Records:
        """A copy of all rows that are whole."""
        return _whole(self._stored)

    @property
    def holds(self) -> bool:
        """Whether a message of these rows is still to be delivered."""
        return bool((self._stored["fate"] & HELD).any())

    def amend(self, place: int, fate: int) -> Records:
        """Change the fate of a row; returns the row as it was, (1,)."""
        before = _whole(self._stored[place : place + 1])
        self._stored["fate"][place] = fate + STORED
        return before

    @property
    def full(self) -> bool:
        """Whether all rows were taken."""
        return self.handed == len(self._stored)

    def remove(self) -> None:
        """Remove the file. The memory goes with the last reference to it."""
        if self.path is not None:
            world().disk.remove(self.path, missing_ok=True)


def _mapped(path: Path, size: int) -> mmap.mmap:
    """A new file, complete at once under its name. Raises OSError if the disk is full."""
    with private_replacement(path, lasting=False) as unfinished, world().disk.open(unfinished, "r+b") as file:
        return world().disk.map(file, 0, size, populate=True)


def _whole(stored: Records) -> Records:
    """A copy of the stored records that are complete, with their fates."""
    records: Records = stored[stored["fate"] != 0]
    records["fate"] = (records["fate"] & ~np.uint8(HELD)) - STORED
    return records


def records_in(path: Path, killed: bool = False) -> Records:
    """The whole records of a part's file, in order. Raises OSError if it cannot be read.

    killed: whether the process that wrote them was killed, so that what was still to be delivered never was.
    """
    stored = np.fromfile(path, RECORD)
    stored["fate"][stored["time"] == 0.0] = 0  # a power cut left only the page with the end of such a record
    if killed:
        stored["fate"][(stored["fate"] & HELD) != 0] = WireFate.UNDERWAY + STORED
    return _whole(stored)


def table_of(records: Records, words: Words) -> pa.Table:
    """Records as a table with the columns `PARQUET`."""
    fates = records["fate"]
    none, unlinked = fates == WireFate.DELIVERED, records["link"] == UNLINKED
    links = np.where(unlinked, 0, records["link"]).astype(np.int32)
    columns = (
        pa.array(records["time"]),
        pa.DictionaryArray.from_arrays(pa.array(links, mask=unlinked), pa.array(list(words.links), pa.string())),
        _words(records["key"], words.keys, "key"),
        pa.array(records["size"].astype(np.int64)),
        _words(records["source"], words.sources, "source"),
        pa.array(records["sequence"], mask=records["sequence"] < 0),
        pa.DictionaryArray.from_arrays(pa.array(_WORD_CODES[fates]), pa.array(_WORDS)),
        pa.DictionaryArray.from_arrays(pa.array(_REASON_CODES[fates], mask=none), pa.array(list(REASONS.values()))),
        pa.array(records["delay"]),
        pa.array(records["n"], mask=records["n"] < 0),
        pa.DictionaryArray.from_arrays(
            pa.array((records["kind"] & ~np.uint8(AGAIN)).astype(np.int8)), pa.array(list(_KINDS))
        ),
        pa.array(delivered_again(records)),
    )
    return pa.Table.from_arrays(columns, schema=PARQUET)


def delivered_again(records: Records) -> NDArray[np.bool_]:
    """Whether each message was delivered, and twice."""
    again: NDArray[np.bool_] = ((records["kind"] & AGAIN) != 0) & (records["fate"] == WireFate.DELIVERED)
    return again


def _words(codes: NDArray[np.uint32], words: Mapping[int, str], kind: str) -> pa.DictionaryArray:
    """A dictionary column with only the words that occur; code 0 is null, and a code without a word names itself."""
    distinct, places = np.unique(codes, return_inverse=True)
    texts = [words.get(code, f"unknown {kind} {code}") for code in distinct.tolist()]
    return pa.DictionaryArray.from_arrays(
        pa.array(places.astype(np.int32), mask=codes == 0), pa.array(texts, pa.string())
    )


def records_of(table: pa.Table, links: Mapping[str, int], keys: Mapping[str, int] | None = None) -> Records:
    """The rows of a table as records, without their senders. links, keys: name → code; without keys, all keys have code 0."""
    rows = np.zeros(table.num_rows, RECORD)
    for name, null in (("time", None), ("n", -1), ("sequence", -1), ("delay", None), ("size", None)):
        column = table[name] if null is None else table[name].fill_null(null)
        rows[name] = column.to_numpy()
    rows["key"] = 0 if keys is None else codes_of(table["key"], keys, 0)
    rows["link"] = codes_of(table["link"], links, UNLINKED)
    rows["fate"] = codes_of(table["reason"], _FATES, WireFate.DELIVERED)
    rows["kind"] = codes_of(table["kind"], _KINDS, Kind.PUT) | np.where(table["again"].to_numpy(), AGAIN, 0)
    return rows


def codes_of(column: pa.ChunkedArray, codes: Mapping[str, int], none: int) -> NDArray[np.int64]:
    """The codes of the words of a dictionary column; none: of null, and of an unknown word."""
    parts = [np.empty(0, np.int64)]
    for chunk in column.chunks:
        of_word = np.array([*(codes.get(word, none) for word in chunk.dictionary.to_pylist()), none], np.int64)
        parts.append(of_word[chunk.indices.fill_null(len(of_word) - 1).to_numpy(zero_copy_only=False)])
    return np.concatenate(parts)


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a Parquet file, which is complete under its name. Raises OSError if the disk is full."""
    with private_replacement(path) as unfinished, parquet_writer(unfinished, table.schema) as writer:
        writer.write_table(table)
