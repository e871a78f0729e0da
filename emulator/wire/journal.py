"""The journal of a wire: a record for each message and link, on disk as soon as it is made, and Parquet files made from it.

`record` writes into memory that is mapped from a file, so the record survives the end of the process. A thread hands the records
to listeners ten times a second, and makes a Parquet file from every file of records that is full.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, final

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.slot.link import Change
from evedrop.output import warn
from evedrop.results.folder import make_private
from evedrop.wire.crossing import RECORD, UNLINKED, Crossing, Kind
from evedrop.wire.history import Numbered, WireHistory, highest
from evedrop.wire.journal_part import (
    REASONS,
    STORED,
    JournalPart,
    Records,
    Words,
    amend_parquet,
    table_of,
    write_parquet,
)
from evedrop.wire.journal_reader import (
    JOURNAL_FOLDER,
    UNFINISHED,
    parquet_path,
)
from evedrop.wire.journal_recovery import locked, recover
from evedrop.wire.plan import WirePlan

PART_ROWS = 2**17
"""Records in a file: at 70 000 messages a second it is full after two seconds."""
_TICK = 0.1  # seconds between two blocks for the listeners
_PATIENCE = 10.0  # seconds after the last delay of a part, until its Parquet file is made, and after a full disk
_LARGEST = 2**32 - 1

Listener = Callable[[Records], None]
"""Gets each block of new records."""
AmendmentListener = Callable[[Records, Crossing], None]
"""Gets records that it got before, and the fate that they have now."""

EventListener = Callable[[float, str], None]
"""Gets the time of an event, in seconds since 1970, and a line about it."""


@final
class WireJournal:
    """The journal of one start of a wire. Threads may call its methods at the same time.

    record: (time, n, sequence, delay, key code, source code, size, link code, kind, fate) → the row's number, for `amend`; the
    arguments are as in `RECORD`.
    """

    def __init__(
        self, folder: Path, plan: WirePlan, *, tell: Callable[[str], None] = warn, part_rows: int = PART_ROWS
    ) -> None:
        """Recover what an earlier start left behind, and begin. folder: the wire's; tell: for what the user must know.

        Raises UsageError if another wire uses the folder, if it was made with another seed, or if it cannot be written.
        """
        self.listeners: list[Listener] = []
        self.amendment_listeners: list[AmendmentListener] = []
        self.event_listeners: list[EventListener] = []
        self.incomplete_since: float | None = None
        """The time from which on the disk had no room for something; None: the journal is complete."""
        self.recorded = 0
        """The number of all records, when it is closed."""
        self.missing = 0
        """The number of records for which the disk had no room; listeners got them."""
        self.links = [link.name for link in plan.links]
        """The names of the links, in the order of their codes."""
        self._tell = tell
        self.folder = folder
        """The wire's folder."""
        self._folder = folder / JOURNAL_FOLDER
        self._place = self._folder / UNFINISHED
        self._rows = part_rows
        self._state = threading.RLock()  # guards the parts
        self._handing = threading.RLock()  # so that listeners get blocks in order
        self._naming = threading.Lock()
        self._codes: dict[str, dict[str, int]] = {"key": {"": 0}, "source": {"": 0}}
        self._texts: dict[str, list[str]] = {"key": [""], "source": [""]}
        self._parts: dict[int, JournalPart] = {}
        self._buffers: dict[int, Any] = {}
        self._next = 0  # the part whose rows are handed over now
        self._amended: deque[tuple[Records, Crossing]] = deque()
        self._number = itertools.count()
        self._amended_late: deque[tuple[int, Crossing]] = deque()
        self._convert_after = 0.0
        try:
            make_private(self._place)
            self._lock = locked(self._folder)
            try:
                self._begin(plan)
            except BaseException:
                os.close(self._lock)
                raise
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be written ({error.strerror}); make room, or give another --out"
            ) from error
        self.record = self._recorder()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tend, name="journal", daemon=True)
        self._thread.start()

    def _begin(self, plan: WirePlan) -> None:
        self._history = WireHistory.read(self._folder)
        self.recovered = recover(self._folder, self._history)
        """The number of records that were left behind by an earlier start, because it was killed or the disk was full."""
        self.counts: dict[Numbered, int] = dict(self._history.counts)
        """(link, key, kind of stream) → the number of its next message, as of the records handed to the listeners."""
        self._history.begin(plan, time.time())
        self._words = os.open(
            self._place / f"{self._history.start:03d}.words", os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600
        )
        self._alive = os.open(self._place / "alive", os.O_WRONLY | os.O_CREAT, 0o600)
        self._beat()
        self._add_part(0)

    @property
    def start(self) -> int:
        """The number of this start of the wire in its folder, from 1."""
        return self._history.start

    def key_code(self, key: str) -> int:
        """The code of a key in records."""
        return self._codes["key"].get(key) or self._new_code("key", key)

    def source_code(self, source: str) -> int:
        """The code of a sender in records; 0 for "", a sender that is not known."""
        return self._codes["source"].get(source) or self._new_code("source", source)

    def key_of(self, code: int) -> str:
        """The key that has a code."""
        return self._texts["key"][code]

    def source_of(self, code: int) -> str:
        """The sender that has a code."""
        return self._texts["source"][code]

    def changes_of(self, link: str, key: str, kind: str) -> tuple[Change, ...]:
        """The settings that the messages of a stream had, from message 0 on: what `KeyFates` needs to go on."""
        return self._history.changes_of(link, key, kind)

    def change(self, link: str, settings: Mapping[str, Any], since: Mapping[tuple[str, str], int]) -> None:
        """Note other settings of a link. since: (key, kind of stream) → the number of its first message that has them."""
        with self._state:
            try:
                self._history.change(link, settings, since, time.time())
            except OSError as error:
                self._miss(error, time.time())

    def note(self, line: str) -> None:
        """Note an event that happens now, and tell the listeners."""
        now = time.time()
        with self._state:
            try:
                self._history.note(line, now)
            except OSError as error:
                self._miss(error, now)
        self._hear(self.event_listeners, now, line)

    def amend(self, row: int, fate: Crossing) -> None:
        """Change the fate of a row that was recorded."""
        at, place = divmod(row, self._rows)
        with self._state:
            part = self._parts.get(at)
            if part is None:
                self._amended_late.append((row, fate))
                return
            before = part.amend(place, fate)
            if place < part.handed:
                self._amended.append((before, fate))

    def flush(self) -> None:
        """Hand all records to the listeners now, and all amendments."""
        with self._handing:
            while True:
                with self._state:
                    amended = [self._amended.popleft() for _ in range(len(self._amended))]
                    part = self._parts.get(self._next)
                    block = np.empty(0, RECORD) if part is None else part.take()
                    if part is not None and part.full:
                        self._next += 1
                for fate in {fate for _, fate in amended}:
                    records = np.concatenate([record for record, its in amended if its == fate])
                    self._hear(self.amendment_listeners, records, fate)
                if part is None or not len(block):
                    return
                if part.path is None:
                    self.missing += len(block)
                self._count(block)
                self._hear(self.listeners, block)

    def close(self) -> None:
        """Hand over and write everything, and let another wire use the folder. Nothing may be recorded any more."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._thread.join()
        self.recorded = next(self._number)
        self.flush()
        try:
            self._amend_converted()
            for at in sorted(self._parts):
                self._convert(at)
            self._history.end(self.counts, time.time(), self.missing)
            shutil.rmtree(self._place)
        except OSError as error:
            self._tell(
                f"the journal's last Parquet files cannot be written ({error.strerror}); its records stay in {self._place}, "
                "where all commands read them; make room, and the next start of the wire makes the files"
            )
        for descriptor in (self._words, self._alive, self._lock):
            os.close(descriptor)

    def __enter__(self) -> WireJournal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

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
                room(part, time)
            at, stored = row % rows * width, fate + STORED
            try:
                write(buffers[part], at, time, n, sequence, delay, key, source, size, link, kind, stored)
            except does_not_fit:  # a row that is not written would hold up all later ones
                fits = min(size, _LARGEST)
                write(buffers[part], at, time, n, -1, delay, key, source, fits, link, kind, stored)
            return row

        return record

    def _room(self, at: int, now: float) -> None:
        """Make a part in the thread that records, because the journal's own thread could not do so in time."""
        with self._state:
            if at not in self._buffers:
                try:
                    self._add_part(at)
                except OSError as error:
                    self._miss(error, now)
                    self._parts[at] = JournalPart(None, self._rows)
                    self._buffers[at] = self._parts[at].buffer

    def _add_part(self, at: int) -> None:
        self._parts[at] = JournalPart(self._place / f"{self._history.start:03d}-{at + 1:04d}.rows", self._rows)
        self._buffers[at] = self._parts[at].buffer

    def _tend(self) -> None:
        """The thread: blocks for the listeners, room for the next records, Parquet files."""
        while not self._ended.wait(_TICK):
            self.flush()
            with contextlib.suppress(OSError):  # a wire that is killed then has less to say of delayed messages
                self._beat()
            with self._state, contextlib.suppress(OSError):  # `_room` tries again, and tells of it
                part = self._parts.get(self._next)
                if part is not None and 2 * part.handed > self._rows and self._next + 1 not in self._buffers:
                    self._add_part(self._next + 1)
            now = time.time()
            over = sorted(at for at, part in self._parts.items() if part.full and part.settled + _PATIENCE < now)
            for at in over:
                if self._parts[at].path is None:  # it was in memory alone, where there is no room for many
                    self._convert(at)
            if now < self._convert_after:
                continue
            try:
                self._amend_converted()
                for at in over[:1]:
                    if at in self._parts:
                        self._convert(at)
            except OSError:  # the records are safe where they are
                self._convert_after = now + _PATIENCE

    def _beat(self) -> None:
        os.pwrite(self._alive, struct.pack("<d", time.time()), 0)

    def _hear(self, listeners: list[Any], *what: Any) -> None:
        for listener in list(listeners):
            try:
                listener(*what)
            except Exception as error:  # a broken view must not end the journal
                listeners.remove(listener)
                self._tell(f"{listener!r} failed and gets no more records of the journal: {error!r}")

    def _count(self, block: Records) -> None:
        """Raise `counts` to the numbers in a block."""
        rows = block[(block["n"] >= 0) & (block["link"] != UNLINKED)]
        link, key, kind = (rows[name].astype(np.uint64) for name in ("link", "key", "kind"))
        streams = link << np.uint64(40) | key << np.uint64(8) | kind & np.uint64(0x7F)
        found, places = np.unique(streams, return_inverse=True)
        numbers = np.zeros(len(found), np.int64)
        np.maximum.at(numbers, places, rows["n"] + 1)
        for stream, n in zip(found.tolist(), numbers.tolist(), strict=True):
            name = (self.links[stream >> 40], self.key_of(stream >> 8 & _LARGEST), Kind(stream & 0xFF).stream)
            highest(self.counts, name, n)

    def _convert(self, at: int) -> None:
        """Make the Parquet file of a part, and forget the part. Raises OSError if the disk is full: it stays as it is."""
        part = self._parts[at]
        while True:
            with self._state:
                amendments, records = part.amendments, part.whole()
            if part.path is not None and len(records):
                write_parquet(parquet_path(self._folder, part.path.stem), table_of(records, self._all_words()))
            with self._state:
                if amendments == part.amendments:
                    part.remove()
                    del self._parts[at], self._buffers[at]
                    return

    def _amend_converted(self) -> None:
        """Change fates in Parquet files. Raises OSError if the disk is full."""
        parts: dict[int, dict[int, Crossing]] = {}
        for row, fate in [self._amended_late.popleft() for _ in range(len(self._amended_late))]:
            at, place = divmod(row, self._rows)
            parts.setdefault(at, {})[place] = fate
        for at, fates in parts.items():
            path = parquet_path(self._folder, f"{self._history.start:03d}-{at + 1:04d}")
            if not path.exists():  # its records were in memory alone
                continue
            try:
                before = amend_parquet(path, fates)
            except OSError:
                self._amended_late.extend((at * self._rows + place, fate) for place, fate in fates.items())
                raise
            for amended, fate in zip(before, fates.values(), strict=True):
                self._hear(self.amendment_listeners, self._record_of(amended), fate)

    def _record_of(self, row: Mapping[str, Any]) -> Records:
        """The record of a row of a table."""
        fates = {reason: fate for fate, reason in REASONS.items()}
        record = np.zeros(1, RECORD)
        record["link"] = UNLINKED if row["link"] is None else self.links.index(row["link"])
        record["key"], record["source"] = self.key_code(row["key"]), self.source_code(row["source"] or "")
        record["fate"], record["kind"] = fates.get(row["reason"], Crossing.DELIVERED), Kind[row["kind"].upper()]
        record["sequence"], record["n"] = (-1 if row[name] is None else row[name] for name in ("sequence", "n"))
        for name in ("time", "delay", "size"):
            record[name] = row[name]
        return record

    def _new_code(self, what: str, text: str) -> int:
        with self._naming:
            codes, texts = self._codes[what], self._texts[what]
            if text not in codes:
                texts.append(text)
                self._write_word(json.dumps([what, len(texts) - 1, text]).encode() + b"\n")
                codes[text] = len(texts) - 1  # last, because other threads read it without the lock
            return codes[text]

    def _write_word(self, line: bytes) -> None:
        before = os.fstat(self._words).st_size
        try:
            if os.write(self._words, line) != len(line):
                os.ftruncate(self._words, before)
                raise OSError(28, os.strerror(28))  # ENOSPC: only a full disk accepts part of a line
        except OSError as error:
            self._miss(error, time.time())

    def _all_words(self) -> Words:
        return Words(self.links, dict(enumerate(self._texts["key"])), dict(enumerate(self._texts["source"])))

    def _miss(self, error: OSError, now: float) -> None:
        """Note that the disk did not take something, and tell so the first time."""
        if self.incomplete_since is None:
            self.incomplete_since = now
            at = time.strftime("%H:%M:%S", time.localtime(now))
            self._tell(
                f"the journal is incomplete from {at} on, because {self._folder} cannot be written ({error.strerror}); the wire "
                "goes on; make room"
            )
