"""The records of one start of a wire, in memory that is mapped from files, and the Parquet files made from them.

Source: docs/wire/results.md, the journal.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from evedrop.system.world import world
from evedrop.wire.journal_place import JournalPlace, parquet_path
from evedrop.wire.journal_words import JournalWords
from evedrop.wire.records import HELD, RECORD, STORED, JournalPart, Records, WireFate, table_of, write_parquet

_PATIENCE = 10.0  # seconds after a full disk
_NOT_HELD = ~HELD & 0xFF


@final
class JournalRecords:
    """The records of one start, in parts. Threads may call its methods at the same time.

    record: (time, n, sequence, delay, key code, source code, size, link code, kind, fate) → the row's number, for `amend`; the
    arguments are as in `RECORD`.

    sent: (row) → None: a message whose row was recorded as `HELD` has been delivered.
    """

    def __init__(
        self, place: JournalPlace, start: int, links: Sequence[str], words: JournalWords, part_rows: int
    ) -> None:
        """start: its number, from 1; links: their names, in the order of their codes; part_rows: records in a part.

        Raises OSError.
        """
        self.recorded = 0
        """The number of all records, after `end`."""
        self.missing = 0
        """The number of records that are not on the disk, because it had no room for them; listeners still got them."""
        self._place, self._start, self._links, self._words, self._rows = place, start, links, words, part_rows
        self._lock = world().rlock()  # guards the parts
        self._parts: dict[int, JournalPart] = {}
        self._buffers: dict[int, Any] = {}
        self._number = itertools.count()
        self._next = 0  # the part whose rows are handed over now
        self._amended: deque[tuple[Records, WireFate]] = deque()
        self._full_until = 0.0  # when to try again to write to a disk that was full
        self._add_part(0)
        self.record, self.sent = self._recorder(), self._sender()

    def amend(self, row: int, fate: WireFate) -> None:
        """Change the fate of a row that was recorded as `HELD`, for which its part has waited; after the wire, nothing."""
        at, place = divmod(row, self._rows)
        with self._lock:
            part = self._parts.get(at)
            if part is None:
                return
            before = part.amend(place, fate)
            if place < part.handed:
                self._amended.append((before, fate))

    def take(self) -> tuple[list[tuple[Records, WireFate]], Records]:
        """The rows (1,) that were taken before and amended since, with the fates that they have now; and the next new rows."""
        with self._lock:
            amended = [self._amended.popleft() for _ in range(len(self._amended))]
            part = self._parts.get(self._next)
            if part is None:
                return amended, np.empty(0, RECORD)
            block = part.take()
            if part.path is None:
                self.missing += len(block)
            if part.full:
                self._next += 1
            return amended, block

    def tend(self, now: float) -> None:
        """Make room for the next records, and the Parquet file of a full part of which no message is `HELD`."""
        with self._lock, contextlib.suppress(OSError):  # `_room` tries again, and reports it
            part = self._parts.get(self._next)
            if part is not None and 2 * part.handed > self._rows and self._next + 1 not in self._buffers:
                self._add_part(self._next + 1)
        with self._lock:  # a thread that records may make a part
            over = sorted(at for at, part in self._parts.items() if part.full and not part.holds)
        for at in [at for at in over if self._parts[at].path is None]:  # many parts would need too much memory
            self._convert(at)
        if now < self._full_until:
            return
        try:
            for at in over[:1]:
                if at in self._parts:
                    self._convert(at)
        except OSError:  # the records are safe where they are
            self._full_until = now + _PATIENCE

    def end(self) -> None:
        """Count all records: there will be no more."""
        self.recorded = next(self._number)

    def write_all(self) -> None:
        """Make the Parquet files of all parts. Raises OSError if the disk is full: the parts stay as they are."""
        for at in sorted(self._parts):
            self._convert(at)

    def _recorder(self) -> Callable[..., int]:
        """The function `record`, which looks nothing up in the object: it is called for every message."""
        number, rows, width, buffers = self._number.__next__, self._rows, RECORD.itemsize, self._buffers
        write, room, does_not_fit = struct.Struct("<dqqdIIIHBB").pack_into, self._room, struct.error

        def record(
            time: float,
            n: int,
            sequence: int,
            delay: float,
            key: int,
            source: int,
            size: int,
            link: int,
            kind: int,
            fate: int,
        ) -> int:
            row = number()  # atomic
            part = row // rows
            if part not in buffers:
                room(part)
            at, stored = row % rows * width, fate + STORED
            try:
                write(buffers[part], at, time, n, sequence, delay, key, source, size, link, kind, stored)
            except does_not_fit:  # a row that is not written would hold up all later ones
                fits = min(size, 2**32 - 1)
                write(buffers[part], at, time, n, -1, delay, key, source, fits, link, kind, stored)
            return row

        return record

    def _sender(self) -> Callable[[int], None]:
        """The function `sent`, which looks nothing up in the object either."""
        rows, width, last, part_of = self._rows, RECORD.itemsize, RECORD.itemsize - 1, self._buffers.get

        def sent(row: int) -> None:
            buffer = part_of(row // rows)
            if buffer is not None:  # it is None after the wire
                buffer[row % rows * width + last] &= _NOT_HELD

        return sent

    def _room(self, at: int) -> None:
        """Make a part in the thread that records, because the journal's own thread could not do so in time."""
        with self._lock:
            if at not in self._buffers:
                try:
                    self._add_part(at)
                except OSError as error:
                    self._place.miss(error)
                    self._add_part(at, in_memory=True)

    def _add_part(self, at: int, in_memory: bool = False) -> None:
        path = None if in_memory else self._place.unfinished / f"{self._name(at)}.rows"
        self._parts[at] = part = JournalPart(path, self._rows)
        self._buffers[at] = part.buffer

    def _convert(self, at: int) -> None:
        """Make the Parquet file of a part, and forget the part.

        Raises OSError if the disk is full: the part stays as it is. A part in memory is forgotten all the same.
        """
        part = self._parts[at]
        records = part.whole()
        try:
            if len(records):
                path = parquet_path(self._place.folder, self._name(at))
                write_parquet(path, table_of(records, self._words.words(self._links)))
            if part.path is None:
                self.missing -= len(records)
        except OSError:
            if part.path is not None:
                raise
        with self._lock:
            part.remove()
            del self._parts[at], self._buffers[at]

    def _name(self, at: int) -> str:
        """The name of a part, from 0, as `part_names` finds it."""
        return f"{self._start:03d}-{at + 1:04d}"
