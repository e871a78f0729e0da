"""The journal of a wire: a record for each message and link, on disk as soon as it is made, and Parquet files made from it.

`record` writes into memory that is mapped from a file, so the record survives the end of the process. A thread hands the records
to listeners ten times a second, and makes a Parquet file from every file of records that is full.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import shutil
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.slot.link import Change
from evedrop.results.wire_summary import JournalState
from evedrop.system.output import warn
from evedrop.system.threads import wait_for_thread
from evedrop.wire.history import NotedEvent, Numbered, WireHistory, highest
from evedrop.wire.journal_part import (
    STORED,
    JournalPart,
    Records,
    amend_parquet,
    records_of,
    table_of,
    write_parquet,
)
from evedrop.wire.journal_place import JournalPlace
from evedrop.wire.journal_reader import JOURNAL_FOLDER, parquet_path
from evedrop.wire.journal_recovery import recover
from evedrop.wire.journal_words import JournalWords
from evedrop.wire.key_limit import KeyLimit
from evedrop.wire.plan import WirePlan
from evedrop.wire.record import HELD, RECORD, WireFate, next_numbers

PART_ROWS = 2**17
"""Records in a file: at 70 000 messages a second it is full after two seconds."""
_TICK = 0.1  # seconds between two blocks for the listeners
_PATIENCE = 10.0  # seconds after the last delay of a part, until its Parquet file is made, and after a full disk

Listener = Callable[[Records], None]
"""Gets each block of new records."""
AmendmentListener = Callable[[Records, WireFate], None]
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
        """Recover the records of an earlier start, and begin. folder: the wire's; tell: for what the user must know.

        Raises UsageError if another wire uses the folder, if it was made with another seed, or if it cannot be written.
        """
        self.listeners: list[Listener] = []
        self.amendment_listeners: list[AmendmentListener] = []
        self.event_listeners: list[EventListener] = []
        self.recorded = 0
        """The number of all records, when it is closed."""
        self.missing = 0
        """The number of records that are not on the disk, because it had no room for them; listeners still got them."""
        self.links = [link.name for link in plan.links]
        """The names of the links, in the order of their codes."""
        self._tell, self._rows = tell, part_rows
        self.folder = folder
        """The wire's folder."""
        self._folder = folder / JOURNAL_FOLDER
        self._state = threading.RLock()  # guards the parts
        self._handing = threading.RLock()  # so that listeners get blocks in order
        self._parts: dict[int, JournalPart] = {}
        self._buffers: dict[int, Any] = {}
        self._next = 0  # the part whose rows are handed over now
        self._amended: deque[tuple[Records, WireFate]] = deque()
        self._number = itertools.count()
        self._stopped, self._convert_after = math.inf, 0.0
        self._amended_late: deque[tuple[int, WireFate]] = deque()
        try:
            self._place = JournalPlace(self._folder, tell)
            try:
                self._begin(plan)
            except BaseException:
                self._place.close()
                raise
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be written ({error.strerror}); make room, or give another folder"
            ) from error
        self.record = self._recorder()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tend, name="journal", daemon=True)
        self._thread.start()

    def _begin(self, plan: WirePlan) -> None:
        self._history = WireHistory.read(self._folder)
        self._history.expect_settings()
        self._history.expect_seed(plan)  # before the recovery: a start that is refused changes nothing
        self.recovered = recover(self._folder, self._history)
        """The number of records that an earlier start left behind, because it was killed or the disk was full."""
        self.counts: dict[Numbered, int] = dict(self._history.counts)
        """(link, key, kind of stream) → the number of its next message, as of the records handed to the listeners."""
        self._history.begin(plan, time.time())
        self._began = time.monotonic()  # the recovery of an earlier start does not count
        admits = KeyLimit(plan.links, self.counts, self._tell).admits
        self._words = JournalWords(self._place.unfinished, self.start, self._place.miss, admits)
        self._place.begin()
        self._add_part(0)

    @property
    def start(self) -> int:
        """The number of this start of the wire in its folder, from 1."""
        return self._history.start

    @property
    def seconds(self) -> float:
        """How long this start has lasted."""
        return min(time.monotonic(), self._stopped) - self._began

    @property
    def incomplete_since(self) -> float | None:
        """When something could not be written for the first time, in seconds since 1970; None: the disk always had room."""
        return self._place.incomplete_since

    @property
    def removed(self) -> Path | None:
        """The journal's folder, or the one inside it, if it was removed or moved while the wire ran."""
        return self._place.removed

    @property
    def state(self) -> JournalState:
        """Whether this start still runs."""
        return "ended" if self._ended.is_set() else "running"

    def key_code(self, key: str, side: str = "") -> int:
        """The code of a key of a side's programs in records; 0 if it is new, and there are too many (`KeyLimit`)."""
        return self._words.key_code(key, side)

    def source_code(self, source: str) -> int:
        """The code of a sender in records; 0 for "", a sender that is not known."""
        return self._words.source_code(source)

    def key_of(self, code: int) -> str:
        """The key that has a code."""
        return self._words.key_of(code)

    def changes_of(self, link: str, key: str, kind: str) -> tuple[Change, ...]:
        """The settings that the messages of a stream had, from message 0 on: what `KeyFates` needs to continue."""
        return self._history.changes_of(link, key, kind)

    def change(self, link: str, settings: Mapping[str, Any], since: Mapping[tuple[str, str], int]) -> None:
        """Note other settings of a link. since: (key, kind of stream) → the number of its first message that has them."""
        with self._state:
            try:
                self._history.change(link, settings, since, time.time())
            except OSError as error:
                self._place.miss(error)

    @property
    def events(self) -> list[NotedEvent]:
        """The events of this start so far, with seconds since it began."""
        with self._state:
            return self._history.events

    def note(self, line: str, *, bypass: bool = False) -> None:
        """Note an event that happens now, and tell the listeners. bypass: whether it tells a way past the wire."""
        now = time.time()
        with self._state:
            try:
                self._history.note(line, now, bypass)
            except OSError as error:
                self._place.miss(error)
        self._hear(self.event_listeners, now, line)

    def amend(self, row: int, fate: WireFate) -> None:
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

    def sent(self, row: int) -> None:
        """Note that a message whose row was recorded as `HELD` has been delivered."""
        at, place = divmod(row, self._rows)
        if (buffer := self._buffers.get(at)) is not None:  # its Parquet file never has the mark
            buffer[(place + 1) * RECORD.itemsize - 1] &= ~HELD & 0xFF

    def flush(self) -> None:
        """Hand all records to the listeners now, and all amendments."""
        with self._handing:
            while True:
                with self._state:
                    amended = [self._amended.popleft() for _ in range(len(self._amended))]
                    part = self._parts.get(self._next)
                    block = np.empty(0, RECORD) if part is None else part.take()
                    if part is not None and part.path is None:
                        self.missing += len(block)
                    if part is not None and part.full:
                        self._next += 1
                for fate in {fate for _, fate in amended}:
                    records = np.concatenate([record for record, its in amended if its == fate])
                    self._hear(self.amendment_listeners, records, fate)
                if part is None or not len(block):
                    return
                self._count(block)
                self._hear(self.listeners, block)

    def close(self) -> None:
        """Hand over and write everything, and let another wire use the folder. Nothing may be recorded any more."""
        if self._ended.is_set():
            return
        self._ended.set()
        wait_for_thread(self._thread)
        self._stopped = time.monotonic()
        self.recorded = next(self._number)
        self.flush()
        self._place.poll()
        if self.removed is not None:
            self.missing = self.recorded
        else:
            self._finish()
        self._words.close()
        self._place.close()

    def _finish(self) -> None:
        try:
            self._amend_converted()
            for at in sorted(self._parts):
                self._convert(at)
            self._history.end(self.counts, time.time(), self.missing)
            shutil.rmtree(self._place.unfinished)
        except OSError as error:
            self._tell(
                f"the journal's last Parquet files cannot be written ({error.strerror}); its records stay in "
                f"{self._place.unfinished}, where all commands read them; make room, and the next start of the wire makes the "
                "files"
            )

    def __enter__(self) -> WireJournal:
        return self

    def __exit__(self, *error: object) -> None:
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
                room(part)
            at, stored = row % rows * width, fate + STORED
            try:
                write(buffers[part], at, time, n, sequence, delay, key, source, size, link, kind, stored)
            except does_not_fit:  # a row that is not written would hold up all later ones
                fits = min(size, 2**32 - 1)
                write(buffers[part], at, time, n, -1, delay, key, source, fits, link, kind, stored)
            return row

        return record

    def _room(self, at: int) -> None:
        """Make a part in the thread that records, because the journal's own thread could not do so in time."""
        with self._state:
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

    def _name(self, at: int) -> str:
        return f"{self.start:03d}-{at + 1:04d}"

    def _tend(self) -> None:
        """The thread: blocks for the listeners, room for the next records, Parquet files."""
        while not self._ended.wait(_TICK):
            self.flush()
            with contextlib.suppress(OSError):  # only a killed wire needs to have noted it
                self._place.beat()
            self._place.poll()
            with self._state, contextlib.suppress(OSError):  # `_room` tries again, and reports it
                part = self._parts.get(self._next)
                if part is not None and 2 * part.handed > self._rows and self._next + 1 not in self._buffers:
                    self._add_part(self._next + 1)
            now = time.time()
            with self._state:  # a thread that records may make a part
                settled = [at for at, part in self._parts.items() if part.full and part.settled + _PATIENCE < now]
            over = sorted(at for at in settled if not self._parts[at].holds)
            for at in [at for at in over if self._parts[at].path is None]:  # many parts would need too much memory
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

    def _hear(self, listeners: list[Any], *what: Any) -> None:
        for listener in list(listeners):
            try:
                listener(*what)
            except Exception as error:  # a broken view must not end the journal
                listeners.remove(listener)
                self._tell(f"{listener!r} failed and gets no more records of the journal: {error!r}")

    def _count(self, block: Records) -> None:
        """Raise `counts` to the numbers in a block."""
        for link, key, kind, n in next_numbers(block):
            highest(self.counts, (self.links[link], self.key_of(key), kind.stream), n)

    def _convert(self, at: int) -> None:
        """Make the Parquet file of a part, and forget the part.

        Raises OSError if the disk is full: the part stays as it is. A part in memory is forgotten all the same.
        """
        part, path = self._parts[at], parquet_path(self._folder, self._name(at))
        while True:
            with self._state:
                amendments, records = part.amendments, part.whole()
            try:
                if len(records):
                    write_parquet(path, table_of(records, self._words.words(self.links)))
                written = len(records)
            except OSError:
                if part.path is not None:
                    raise
                written = 0
            with self._state:
                if amendments == part.amendments:
                    if part.path is None:
                        self.missing -= written
                    part.remove()
                    del self._parts[at], self._buffers[at]
                    return

    def _amend_converted(self) -> None:
        """Change fates in Parquet files. Raises OSError if the disk is full."""
        parts: dict[int, dict[int, WireFate]] = {}
        for row, fate in [self._amended_late.popleft() for _ in range(len(self._amended_late))]:
            at, place = divmod(row, self._rows)
            parts.setdefault(at, {})[place] = fate
        links = {name: code for code, name in enumerate(self.links)}
        for at, fates in parts.items():
            path = parquet_path(self._folder, self._name(at))
            if not path.exists():  # the disk had no room for this part
                continue
            try:
                before = records_of(amend_parquet(path, fates), links, self._words.key_codes)
            except OSError:
                self._amended_late.extend((at * self._rows + place, fate) for place, fate in fates.items())
                raise
            for i, fate in enumerate(fates.values()):
                self._hear(self.amendment_listeners, before[i : i + 1], fate)
