"""The journal of a wire that runs: a record for each message and link, on disk as soon as it is made.

A `WireJournal` has four parts. `JournalRecords` (journal_records.py) writes each record into memory that is mapped from a file,
so the record survives the end of the process. `JournalWords` (journal_words.py) gives codes to keys and senders. `JournalPlace`
(journal_place.py) locks the folder for this process, and notes when the wire was last alive, and what could not be written.
`WireHistory` (history.py) has the starts, the events and the changes of settings. The journal's thread hands the records to
listeners ten times a second, and lets a Parquet file be made from every file of records that is full. What an earlier start left
behind, because it was killed or the disk was full, is recovered.

Source: docs/wire/results.md, the journal, a wire that starts again.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, ParamSpec, Self, final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from evedrop.errors import UsageError
from evedrop.results.wire_summary import JournalState, JournalSummary
from evedrop.system.output import warn
from evedrop.system.threads import Thread
from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world
from evedrop.wire.history import Numbered, WireHistory, highest
from evedrop.wire.journal_place import (
    JOURNAL_FOLDER,
    UNFINISHED,
    JournalPlace,
    last_beat,
    parquet_path,
    part_names,
    start_of,
)
from evedrop.wire.journal_reading import damaged, unfinished_table
from evedrop.wire.journal_records import JournalRecords
from evedrop.wire.journal_words import JournalWords, KeyLimit
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import Kind, Records, WireFate, next_numbers, write_parquet

PART_ROWS = 2**17
"""Records in a file: at 70 000 messages a second it is full after two seconds."""
_TICK = 0.1  # seconds between two blocks for the listeners
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
        """Lock the folder, and read what earlier starts left. folder: the wire's; tell: for what the user must know.

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
        self._plan, self._part_rows = plan, part_rows
        self._thread: Thread | None = None
        with self._opening() as stack:
            self.place = JournalPlace(folder / JOURNAL_FOLDER, tell)
            stack.callback(self.close)
            self.history = WireHistory.read(self.place.folder)
            self.history.expect_settings()
            self.history.expect_seed(plan)
            stack.pop_all()

    def begin(self) -> Self:
        """Recover the records of an earlier start, and begin the next one. Before it, this start has changed nothing.

        Raises UsageError if the folder is damaged or cannot be written; then the journal is closed.
        """
        with self._opening() as stack:
            stack.callback(self.close)
            self._begin(self._plan, self._part_rows)
            stack.pop_all()
        self._thread = world().thread(self._tend, name="journal")
        self._thread.start()
        return self

    @contextlib.contextmanager
    def _opening(self) -> Iterator[contextlib.ExitStack]:
        """A stack for what is undone after an error."""
        try:
            with contextlib.ExitStack() as stack:
                yield stack
        except OSError as error:
            raise UsageError(
                f"{self.folder} cannot be written ({error.strerror}); make room, or give another folder"
            ) from error

    def _begin(self, plan: WirePlan, part_rows: int) -> None:
        self.recovered = recover(self.place.folder, self.history)
        """The number of records that an earlier start left behind, because it was killed or the disk was full."""
        self.counts: dict[Numbered, int] = dict(self.history.counts)
        """(link, key, kind of stream) → the number of its next message, as of the records handed to the listeners."""
        self.history.begin(plan, self.place.clock.time(), self.recovered)
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
            self.history.change(link, settings, since, self.place.clock.time())

    def note(self, line: str, *, bypass: bool = False) -> None:
        """Note an event that happens now, and tell the listeners. bypass: whether it tells a way past the wire."""
        now = self.place.clock.time()
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
        if self._thread is not None:
            self._end(self._thread)
        self.place.close()

    def _end(self, thread: Thread) -> None:
        wait_for_thread(thread)
        self._stopped = world().monotonic()
        self.records.end()
        self.flush()
        self.place.poll()
        if self.place.removed is not None:
            self.records.missing = self.recorded
        else:
            self._finish()
        self.words.close()

    def _finish(self) -> None:
        try:
            self.records.write_all()
            self.history.end(self.counts, self.place.clock.time(), self.completeness)
            world().disk.remove_tree(self.place.unfinished)
        except OSError as error:
            self._tell(
                f"the journal's last Parquet files cannot be written ({error.strerror}); its records stay in "
                f"{self.place.unfinished}, where all commands read them; make room, and the next start of the wire makes the "
                "files"
            )

    def __enter__(self) -> Self:
        return self.begin()

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
            self.records.tend(self.place.clock.time())


def recover(journal: Path, history: WireHistory) -> int:
    """Make Parquet files from all that an earlier start left behind, and end that start; returns the number of such records.

    Raises OSError if the disk is full, and UsageError if a file is damaged; then nothing is lost.
    """
    place = journal / UNFINISHED
    recovered, alive = 0, last_beat(place)
    starts = {name: start_of(name) for name in part_names(journal)}
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
