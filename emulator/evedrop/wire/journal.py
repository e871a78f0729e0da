"""The journal of a wire: a record for each message and link, on disk as soon as it is made, and Parquet files made from it.

A `WireJournal` has four parts. `JournalRecords` writes each record into memory that is mapped from a file, so the record
survives the end of the process. `JournalWords` gives codes to keys and senders. `JournalPlace` locks the folder for this
process, and notes when the wire was last alive, and what could not be written. `WireHistory` (history.py) has the starts, the
events and the changes of settings. The journal's thread hands the records to listeners ten times a second, and lets a Parquet
file be made from every file of records that is full. What an earlier start left behind, because it was killed or the disk was
full, is recovered. `journal_tables` and `JournalOnDisk` read the journal, of a wire that runs or was killed, too.

Records have codes for keys and senders. A line of the file `NNN.words` has a code and its text, so the records of a wire that
was killed can be read. The end of the file is mapped into memory, as records are: a call of the system for each word costs many
times as much, above all since other threads run meanwhile. Until it is closed, zeros follow the last line. Since a wire keeps
the records of a key until it ends, there is a limit on the keys that programs use: one for each side, so that programs of one
side cannot use up the keys of others.

Source: docs/wire/results.md, the journal, a wire that starts again; docs/wire/semantics.md, many keys.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import mmap
import os
import re
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any, Generic, ParamSpec, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import zenoh

from evedrop.errors import UsageError
from evedrop.model.checks import as_toml
from evedrop.model.slot.link import NEVER
from evedrop.results.folder import make_private
from evedrop.results.wire_summary import JournalState, JournalSummary
from evedrop.system.files import is_locked, lines_in, try_lock
from evedrop.system.output import warn
from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world
from evedrop.wire.history import Numbered, WireHistory, highest
from evedrop.wire.plan import WireLink, WirePlan, numbered_as
from evedrop.wire.records import (
    HELD,
    PARQUET,
    RECORD,
    STORED,
    UNLINKED,
    JournalPart,
    Kind,
    Records,
    WireFate,
    Words,
    next_numbers,
    records_in,
    records_of,
    table_of,
    write_parquet,
)

PART_ROWS = 2**17
"""Records in a file: at 70 000 messages a second it is full after two seconds."""
_TICK = 0.1  # seconds between two blocks for the listeners
_PATIENCE = 10.0  # seconds after a full disk
_NOT_HELD = ~HELD & 0xFF

_P = ParamSpec("_P")


@final
class Listeners(list[Callable[_P, None]], Generic[_P]):
    """Functions that are called for each new part of a journal. One that fails is called no more, and the user is told."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """tell: for what the user must know."""
        super().__init__()
        self._tell = tell

    def hear(self, *arguments: _P.args, **named: _P.kwargs) -> None:
        """Call all of them."""
        for listener in list(self):
            try:
                listener(*arguments, **named)
            except Exception as error:  # a broken view must not end the journal
                self.remove(listener)
                self._tell(f"{listener!r} failed and gets no more records of the journal: {error!r}")


@final
class WireJournal:
    """The journal of one start of a wire, and the thread that tends it. Threads may call its methods at the same time."""

    def __init__(
        self, folder: Path, plan: WirePlan, *, tell: Callable[[str], None] = warn, part_rows: int = PART_ROWS
    ) -> None:
        """Recover the records of an earlier start, and begin. folder: the wire's; tell: for what the user must know.

        Raises UsageError if another wire uses the folder, if it was made with another seed, or if it cannot be written.
        """
        self.folder = folder
        """The wire's folder."""
        self.listeners: Listeners[Records] = Listeners(tell)
        """They get each block of new records."""
        self.amendment_listeners: Listeners[Records, WireFate] = Listeners(tell)
        """They get records that they got before, and the fate that these have now."""
        self.event_listeners: Listeners[float, str] = Listeners(tell)
        """They get the time of an event, in seconds since 1970, and a line about it."""
        self._tell = tell
        self._links = [link.name for link in plan.links]
        self._handing = world().rlock()  # so that listeners get blocks in order
        self._ended = world().event()
        self._stopped = math.inf
        try:
            self.place = JournalPlace(folder / JOURNAL_FOLDER, tell)
            try:
                self._begin(plan, part_rows)
            except BaseException:
                self.place.close()
                raise
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be written ({error.strerror}); make room, or give another folder"
            ) from error
        self._thread = world().thread(self._tend, name="journal")
        self._thread.start()

    def _begin(self, plan: WirePlan, part_rows: int) -> None:
        self.history = WireHistory.read(self.place.folder)
        self.history.expect_settings()
        self.history.expect_seed(plan)  # before the recovery: a start that is refused changes nothing
        self.recovered = recover(self.place.folder, self.history)
        """The number of records that an earlier start left behind, because it was killed or the disk was full."""
        self.counts: dict[Numbered, int] = dict(self.history.counts)
        """(link, key, kind of stream) → the number of its next message, as of the records handed to the listeners."""
        self.history.begin(plan, world().time(), self.recovered)
        self._began = world().monotonic()  # the recovery of an earlier start does not count
        admits = KeyLimit(plan.links, self.counts, self._tell).admits
        self.words = JournalWords(self.place.unfinished, self.history.start, self.place.miss, admits)
        self.place.begin()
        self.records = JournalRecords(self.place, self.history.start, self._links, self.words, part_rows)

    @property
    def seconds(self) -> float:
        """How long this start has lasted."""
        return min(world().monotonic(), self._stopped) - self._began

    @property
    def state(self) -> JournalState:
        """Whether this start still runs."""
        return "ended" if self._ended.is_set() else "running"

    @property
    def recorded(self) -> int:
        """The number of all records, when it is closed."""
        return self.records.recorded

    @property
    def completeness(self) -> JournalSummary:
        """What an earlier start left behind, and what is not on the disk."""
        return JournalSummary(self.recovered, self.records.missing, self.place.incomplete_since)

    def key_of(self, code: int) -> str:
        """The key that has a code."""
        return self.words.key_of(code)

    def change(self, link: str, settings: Mapping[str, Any], since: Mapping[tuple[str, str], int]) -> None:
        """Note other settings of a link. since: (key, kind of stream) → the number of its first message that has them."""
        with self.place.noting_errors():
            self.history.change(link, settings, since, world().time())

    def note(self, line: str, *, bypass: bool = False) -> None:
        """Note an event that happens now, and tell the listeners. bypass: whether it tells a way past the wire."""
        now = world().time()
        with self.place.noting_errors():
            self.history.note(line, now, bypass)
        self.event_listeners.hear(now, line)

    def flush(self) -> None:
        """Hand all records to the listeners now, and all amendments."""
        with self._handing:
            while True:
                amended, block = self.records.take()
                for fate in {fate for _, fate in amended}:
                    records = np.concatenate([record for record, its in amended if its == fate])
                    self.amendment_listeners.hear(records, fate)
                if not len(block):
                    return
                for link, key, kind, n in next_numbers(block):
                    highest(self.counts, (self._links[link], self.key_of(key), kind.stream), n)
                self.listeners.hear(block)

    def close(self) -> None:
        """Hand over and write everything, and let another wire use the folder. Nothing may be recorded any more."""
        if self._ended.is_set():
            return
        self._ended.set()
        wait_for_thread(self._thread)
        self._stopped = world().monotonic()
        self.records.end()
        self.flush()
        self.place.poll()
        if self.place.removed is not None:
            self.records.missing = self.recorded
        else:
            self._finish()
        self.words.close()
        self.place.close()

    def _finish(self) -> None:
        try:
            self.records.write_all()
            self.history.end(self.counts, world().time(), self.completeness)
            world().disk.remove_tree(self.place.unfinished)
        except OSError as error:
            self._tell(
                f"the journal's last Parquet files cannot be written ({error.strerror}); its records stay in "
                f"{self.place.unfinished}, where all commands read them; make room, and the next start of the wire makes the "
                "files"
            )

    def __enter__(self) -> WireJournal:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _tend(self) -> None:
        """The thread: blocks for the listeners, room for the next records, Parquet files."""
        while not self._ended.wait(_TICK):
            self.flush()
            with contextlib.suppress(OSError):  # only a killed wire needs to have noted it
                self.place.beat()
            with self.place.noting_errors():
                self.history.sync()
            self.place.poll()
            self.records.tend(world().time())


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


_ROOM = 2**18  # bytes of the file that are mapped at once, unless a word is longer


@final
class JournalWords:
    """The keys and senders of one start of a wire. Threads may call its methods at the same time."""

    def __init__(
        self,
        unfinished: Path,
        start: int,
        miss: Callable[[OSError], None],
        admits: Callable[[str, str], bool] = lambda _key, _side: True,
    ) -> None:
        """unfinished: the folder of the file; miss: called when the disk has no room for a word.

        admits: whether there is room for a new key of a side, as `KeyLimit`. Raises OSError.
        """
        self._file = world().disk.open(_path(unfinished, start), "a+b")
        self._size = os.fstat(self._file.fileno()).st_size
        self._map: mmap.mmap | None = None
        self._start = self._end = 0  # of the bytes of the file that are mapped
        self._miss, self._admits = miss, admits
        self._naming, self._admitting = world().lock(), world().lock()
        self._codes: dict[str, dict[str, int]] = {"key": {"": 0}, "source": {"": 0}}
        self._texts: dict[str, list[str]] = {"key": [""], "source": [""]}

    def key_code(self, key: str, side: str = "") -> int:
        """The code of a key that a program of a side uses; 0 if the key is new and the limit is reached."""
        code = self._codes["key"].get(key)
        if code:
            return code
        with self._admitting:  # another thread may ask for the same key, whose place counts once
            if code := self._codes["key"].get(key):
                return code
            return self._new_code("key", key) if self._admits(key, side) else 0

    def source_code(self, source: str) -> int:
        """The code of a sender; 0 for "", a sender that is not known."""
        return self._codes["source"].get(source) or self._new_code("source", source)

    def key_of(self, code: int) -> str:
        """The key that has a code."""
        return self._texts["key"][code]

    def words(self, links: Sequence[str]) -> Words:
        """All codes so far and what they stand for. links: the names of the links, in the order of their codes."""
        return Words(links, dict(enumerate(self._texts["key"])), dict(enumerate(self._texts["source"])))

    def close(self) -> None:
        """Close the file."""
        self._unmap()
        self._file.close()

    def _new_code(self, kind: str, text: str) -> int:
        with self._naming:
            codes, texts = self._codes[kind], self._texts[kind]
            code = codes.get(text)
            if code is None:
                code = len(texts)
                texts.append(text)
                self._write(f'["{kind}", {code}, {json.dumps(text)}]\n'.encode())
                codes[text] = code  # last, because other threads read it without the lock
            return code

    def _write(self, line: bytes) -> None:
        size = self._size + len(line)
        if size > self._end:
            try:
                self._make_room(len(line))
            except OSError as error:
                self._miss(error)
                return
        assert self._map is not None  # noqa: S101 - it ends at `_end`
        self._map[self._size - self._start : size - self._start] = line
        self._size = size

    def _make_room(self, least: int) -> None:
        """Map the rest of the file, and room for some bytes at least. Raises OSError if the disk is full."""
        start = self._size - self._size % mmap.ALLOCATIONGRANULARITY
        length = max(_ROOM, self._size - start + least)
        made = world().disk.map(self._file, start, length)
        if self._map is not None:
            self._map.close()
        self._map, self._start, self._end = made, start, start + length

    def _unmap(self) -> None:
        """Let the file end with its last line."""
        if self._map is not None:
            self._map.close()
            self._map, self._start, self._end = None, 0, 0
            with contextlib.suppress(OSError):  # zeros after the last line do no harm
                self._file.truncate(self._size)


def words_in(unfinished: Path, start: int, links: list[str]) -> Words:
    """The words of a start that has not ended, from its file."""
    words = Words(links, {}, {})
    with contextlib.suppress(FileNotFoundError):
        for line in lines_in(_path(unfinished, start)):
            with contextlib.suppress(ValueError, TypeError, OverflowError, RecursionError):  # a line may be damaged
                kind, code, text = json.loads(line)
                (words.keys if kind == "key" else words.sources)[int(code)] = (
                    str(text).encode("utf-8", "replace").decode()
                )
    return words


def _path(unfinished: Path, start: int) -> Path:
    return unfinished / f"{start:03d}.words"


MOST_KEYS = 2**18
"""The keys that a wire keeps for the programs of a side; each takes some 1 kB."""
MOST_CHARACTERS = 2**25
"""The characters of these keys."""


@final
class KeyLimit:
    """The keys of a wire that are new, counted for each side. Threads may call its methods at the same time."""

    def __init__(self, links: Iterable[WireLink], earlier: Iterable[Numbered], tell: Callable[[str], None]) -> None:
        """earlier: the streams that earlier starts numbered; their keys count, too. tell: for warnings.

        The stream of `KEY/@adv/…` counts as a key until one of these comes, for there is no telling how many there were.
        """
        self._tell = tell
        self._used: dict[str, tuple[int, int]] = {}  # side → keys, characters
        self._full: set[str] = set()
        self._earlier: set[str] = set()
        self._lock = world().lock()
        sources = {link.name: link.source for link in links}
        for link, key, _ in earlier:
            if key not in self._earlier:
                self._earlier.add(key)
                self._take(key, sources.get(link, ""))

    def admits(self, key: str, side: str) -> bool:
        """Whether there is room for a new key that a program of a side uses; then it has its place from now on."""
        with self._lock:
            if key in self._earlier:
                return True
            if (numbered := numbered_as(key)) in self._earlier:  # the first such key has the place of its stream
                self._earlier.remove(numbered)
                return True
            keys, characters = self._used.get(side, (0, 0))
            if keys < MOST_KEYS and characters + len(key) <= MOST_CHARACTERS:
                self._take(key, side)
                return True
            if side in self._full:
                return False
            self._full.add(side)
        self._tell(
            f"programs at the side {side} have used {keys:,} keys of {characters:,} characters, and the wire keeps no more of "
            "them; messages with new keys are dropped as too_many_keys; let these programs use fewer keys"
        )
        return False

    def _take(self, key: str, side: str) -> None:
        keys, characters = self._used.get(side, (0, 0))
        self._used[side] = (keys + 1, characters + len(key))


@final
class JournalPlace:
    """A journal's folder, which this process alone writes to until it calls `close`."""

    def __init__(self, journal: Path, tell: Callable[[str], None]) -> None:
        """Make the folder, and lock it. tell: for what the user must know.

        Raises UsageError if another wire uses the folder, and OSError if it cannot be written.
        """
        self._tell = tell
        self.folder = journal
        """The journal's folder."""
        self.incomplete_since: float | None = None
        """When something could not be written for the first time, in seconds since 1970; None: the disk always had room."""
        self.removed: Path | None = None
        """This folder, or the one inside it, if it was removed or moved since the wire began, as of the last `poll`."""
        self.unfinished = journal / UNFINISHED
        """The folder inside it for records that are not yet in a Parquet file."""
        make_private(journal)
        self._lock = locked(journal)  # before anything is made that a wire which uses the folder might remove
        make_private(self.unfinished)
        self._alive: FileIO | None = None
        self._telling = world().rlock()  # so that threads that miss something at once tell so once

    def begin(self) -> None:
        """Begin to note that the wire is alive, once an earlier start has been recovered. Raises OSError."""
        self._alive = world().disk.open(self.unfinished / "alive", "wb")
        self.beat()

    def beat(self) -> None:
        """Note that the wire is alive now. Raises OSError."""
        assert self._alive is not None  # noqa: S101 - it has begun
        self._alive.seek(0)
        self._alive.write(struct.pack("<d", world().time()))

    def poll(self) -> None:
        """Check whether the folder is still there, and report at once if it is not."""
        with self._telling:
            if self.removed is not None:
                return
            self.removed = self._lost()
            if self.removed is not None:
                self.incomplete_since = self.incomplete_since or world().time()
                self._tell(
                    f"{self.removed} was removed or moved while the wire runs, so the wire no longer has a journal; it goes on; "
                    "end it, and start it again"
                )

    def miss(self, error: OSError) -> None:
        """Note that something could not be written, and tell so the first time."""
        with self._telling:
            self.poll()
            if self.incomplete_since is None:
                self.incomplete_since = world().time()
                at = time.strftime("%H:%M:%S", time.localtime(self.incomplete_since))
                self._tell(
                    f"the journal is incomplete from {at} on, because {self.folder} cannot be written ({error.strerror}); the "
                    "wire goes on; make room"
                )

    @contextlib.contextmanager
    def noting_errors(self) -> Iterator[None]:
        """`miss` an OSError of the block instead of raising it."""
        try:
            yield
        except OSError as error:
            self.miss(error)

    def _lost(self) -> Path | None:
        """The folder, or the one inside it, that was removed, moved or replaced."""
        try:
            if not os.path.samestat(os.fstat(self._lock), os.stat(self.folder)):
                return self.folder
            return self.unfinished if self._alive is not None and os.fstat(self._alive.fileno()).st_nlink == 0 else None
        except (FileNotFoundError, NotADirectoryError):
            return self.folder
        except OSError:  # a disk that does not answer may answer later
            return None

    def close(self) -> None:
        """Let another wire use the folder."""
        if self._alive is not None:
            self._alive.close()
        world().disk.let_go(self._lock)


def locked(folder: Path) -> int:
    """The descriptor of a folder that this process alone may use until it closes it. Raises UsageError if another one does."""
    descriptor = world().disk.hold(folder)
    if not try_lock(descriptor):
        world().disk.let_go(descriptor)
        raise UsageError(f"another wire writes to {folder.parent}; end it, or give another folder")
    return descriptor


def recover(journal: Path, history: WireHistory) -> int:
    """Make Parquet files from all that an earlier start left behind, and end that start; returns the number of such records.

    Raises OSError if the disk is full, and UsageError if a file is damaged; then nothing is lost.
    """
    place = journal / UNFINISHED
    recovered, alive = 0, last_beat(place)
    starts = {name: _start_of(name) for name in part_names(journal)}
    if (latest := max(starts.values(), default=0)) > history.start:  # else the next start would write over them
        raise UsageError(
            f"{journal} has records of start {latest}, but its history lacks that start; give another folder"
        )
    names = [name for name, start in starts.items() if start == history.start]
    counts = dict(history.counts)
    for name in names:
        path = parquet_path(journal, name)
        try:
            if not path.exists():  # of a start that ended, too: a power cut may have taken the name of the file
                table = unfinished_table(place / f"{name}.rows", history.links, killed=True)
                recovered += table.num_rows
                write_parquet(path, table)
            if not history.ended:
                _count_table(counts, path)
        except (pa.ArrowException, KeyError) as error:
            raise damaged(journal, name, error) from error
    if not history.ended:
        history.end(counts, alive)
    for path in (*journal.glob("*.new"), *place.iterdir()):
        world().disk.remove(path)
    return recovered


def _count_table(counts: dict[Numbered, int], path: Path) -> None:
    table = pq.read_table(path, columns=["link", "key", "kind", "n"], filters=pc.field("n").is_valid())
    for row in table.group_by(["link", "key", "kind"]).aggregate([("n", "max")]).to_pylist():
        if row["link"] is None:
            continue
        if row["key"] is None or row["kind"] is None:
            raise pa.ArrowInvalid("a message with a number has no key or no kind")
        highest(counts, (row["link"], row["key"], Kind[row["kind"].upper()].stream), row["n_max"] + 1)


JOURNAL_FOLDER = "journal"
"""The folder inside a wire's folder that contains its journal."""
_LATEST = 1e15  # seconds
UNFINISHED = "unfinished"
"""The folder inside it for records that are not yet in a Parquet file."""


def journal_tables(folder: Path | str, start: int | None = None, killed: bool = False) -> Iterator[pa.Table]:
    """The journal of a wire's folder in the order of its rows, a table for each part.

    The wire may still run, or may have been killed. A journal without messages is one empty table.

    start: only the rows of this start of the wire, from 1; None: the rows of all starts. killed: as for `records_in`.

    Raises UsageError if there is no journal, or a part cannot be read.
    """
    journal = Path(folder) / JOURNAL_FOLDER
    if not journal.is_dir():
        raise UsageError(
            f"{folder} is not the folder of a wire: it has no folder {JOURNAL_FOLDER}; give the results folder of a wire"
        )
    names = [name for name in part_names(journal) if start in {None, _start_of(name)}]
    links = WireHistory.read(journal).links  # after the names: a start is in it before its parts are there
    if not names:
        yield PARQUET.empty_table()
    for name in names:
        try:
            yield _table(journal, name, links, killed)
        except (OSError, pa.ArrowException) as error:
            raise damaged(journal, name, error) from error


def _table(journal: Path, name: str, links: dict[int, list[str]], killed: bool) -> pa.Table:
    path, parquet = journal / UNFINISHED / f"{name}.rows", parquet_path(journal, name)
    with contextlib.suppress(FileNotFoundError):  # a running wire may just have made the Parquet file
        if not parquet.exists():
            table = unfinished_table(path, links, killed)
            if not parquet.exists():  # or else the words may be gone already
                return table
    table = pq.read_table(parquet, schema=PARQUET)
    table.validate(full=True)  # a damaged column of words may name words that are not there
    return table


def _start_of(name: str) -> int:
    """The number of the start that made a part."""
    return int(name.partition("-")[0])


def damaged(journal: Path, name: str, why: object) -> UsageError:
    """The error about a part that cannot be read."""
    return UsageError(
        f"part {name} of the journal in {journal} cannot be read ({why}); remove its file, or give another folder"
    )


def unfinished_table(path: Path, links: Mapping[int, list[str]], killed: bool) -> pa.Table:
    """The records that are not yet in a Parquet file, as a table. Raises OSError, and UsageError if they are damaged.

    links: as in `WireHistory`; killed: as for `records_in`.
    """
    start, records = _start_of(path.stem), records_in(path, killed)
    words = words_in(path.parent, start, links.get(start, []))  # after the records: a word is there before its records
    wrong = ~np.isin(records["fate"], [*WireFate]) | ((records["kind"] & 0x7F) > max(Kind)) | (records["n"] >= NEVER)
    wrong |= (records["link"] != UNLINKED) & (records["link"] >= len(words.links))
    for name in ("time", "delay"):
        wrong |= ~(np.abs(records[name]) < _LATEST)  # not a number, too
    if wrong.any():
        raise damaged(path.parents[1], path.stem, f"record {int(wrong.argmax())} is not one of this wire")
    return table_of(records, words)


def part_names(journal: Path) -> list[str]:
    """The names of all parts of a journal, such as 001-0002 for the second part of the first start, in order."""
    # In this order: a running wire makes the Parquet file of a part before it removes the part's rows.
    names_ = {path.stem for path in (*(journal / UNFINISHED).glob("*.rows"), *journal.glob("*.parquet"))}
    parts = [name for name in names_ if re.fullmatch(r"\d{3,}-\d{4,}", name)]  # a user may keep files of others there
    return sorted(parts, key=lambda name: [int(number) for number in name.split("-")])


def parquet_path(journal: Path, name: str) -> Path:
    """The Parquet file of a part."""
    return journal / f"{name}.parquet"


def last_beat(unfinished: Path) -> float:
    """The latest time that a wire noted while it ran; 0 if it noted none."""
    with contextlib.suppress(OSError, struct.error):
        beat: float = struct.unpack("<d", (unfinished / "alive").read_bytes())[0]
        return beat
    return 0.0


@final
class JournalOnDisk:
    """The journal of the latest start of a wire."""

    def __init__(self, folder: Path, plan: WirePlan) -> None:
        self.listeners: list[Callable[[Records], None]] = []
        self.amendment_listeners: list[Callable[[Records, WireFate], None]] = []
        self.recorded = 0
        self._folder = folder
        self._links = {link.name: link.number for link in plan.links}
        self.history = WireHistory.read(folder / JOURNAL_FOLDER)
        self.seconds = 0.0
        """Until the wire ended, was last alive, or heard its last message, as far as these were read."""
        self.state: JournalState = "ended"
        if not self.history.ended:
            self.state = "running" if is_locked(folder / JOURNAL_FOLDER) else "killed"
        self._keys = [""]  # code 0 stands for all keys beyond the limit
        self._codes = {"": 0}

    def key_of(self, code: int) -> str:
        """The key of a code."""
        return self._keys[code]

    def read(self) -> None:
        """Hand all records to the listeners. Raises UsageError if there is no journal, or it is damaged."""
        self._is_alive_at(last_beat(self._folder / JOURNAL_FOLDER / UNFINISHED))
        for table in journal_tables(self._folder, self.history.start, killed=self.state == "killed"):
            for key in {*_words_of(table["key"])} - {*self._codes}:
                try:
                    zenoh.KeyExpr(key)
                except zenoh.ZError as error:
                    raise UsageError(
                        f"the journal in {self._folder} is damaged: {as_toml(key)} is not a key; remove the journal, or give "
                        "another folder"
                    ) from error
                self._codes[key] = len(self._keys)
                self._keys.append(key)
            records = records_of(table, self._links, self._codes)
            self.recorded += len(records)
            if len(records):
                self._is_alive_at(float(records["time"].max()))
                for listener in self.listeners:
                    listener(records)
        # Again, because a change may have come in between; it is written before the first record that it concerns.
        self.history = WireHistory.read(self._folder / JOURNAL_FOLDER)
        self.history.expect_settings()
        self._is_alive_at(self.history.over)

    @property
    def completeness(self) -> JournalSummary:
        """What an earlier start left behind, and what is not on the disk, if the wire could say so."""
        return self.history.completeness

    def _is_alive_at(self, time: float) -> None:
        self.seconds = max(self.seconds, time - self.history.began)


def _words_of(column: pa.ChunkedArray) -> list[str]:
    """The words that a dictionary column may contain."""
    return [word for chunk in column.chunks for word in chunk.dictionary.to_pylist()]
