"""The recording of a wire: made while it runs, or again from its journal.

The wire appends blocks of rows to a list; a thread counts them and writes the file that viewers read. A viewer or a disk that is
slow, hung or absent cannot delay the wire.

Source: docs/wire/results.md, the view.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, final

import pyarrow.compute as pc
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.errors import UsageError
from evedrop.results.wire_summary import WIRE_FILE
from evedrop.show.view.recording import Chunk, RecordingThread
from evedrop.system.waiting import SteadyClock
from evedrop.system.world import world
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.panels import Pace, WirePanels
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import records_of
from evedrop.wire.time_steps import Notice, StepCounter, WireSteps, introduction, level_of

_MOST_ROWS = 2_000_000  # 100 MB
_LATE = 0.3  # seconds after which the rows of a step are there
_BATCH = 0.5  # seconds between two additions to the recording, each of which takes some kilobytes


class _WireRecording(RecordingThread[Chunk, Notice]):
    """Writes the recording of a wire, from whatever its steps are made of. A subclass sets `_panels` before that."""

    _panels: WirePanels

    @abstractmethod
    def _steps(self, chunks: list[Chunk]) -> Iterable[WireSteps]:
        """The steps that follow from what came since the last call."""

    def _layout(self) -> rrb.Blueprint:
        return self._panels.layout()

    def _style(self, to: rr.RecordingStream) -> None:
        self._panels.style(to)

    def _send(self, chunks: list[Chunk], notes: list[Notice], to: rr.RecordingStream) -> bool:
        every = [*self._steps(chunks)]
        self._panels.notes(notes, to)
        for steps in every:
            self._panels.send(steps, to)
        if self._last:
            self._panels.end(to)
        return bool(every or notes or self._last)


@final
class WireView(_WireRecording[NDArray[Any]]):
    """Writes the recording of a wire to `path`. No method waits, and none raises: see `failure`."""

    def __init__(
        self,
        path: Path,
        plan: WirePlan,
        name: str,
        start: float,
        pace: Pace | None = None,
        clock: Callable[[], float] | None = None,
        most_rows: int = _MOST_ROWS,
    ) -> None:
        """name: identifies the recording. start: when the wire started, in seconds since 1970.

        clock: the time of the wire, by default that of a `SteadyClock`; called once by each round of the thread.
        most_rows: that the thread may be behind.
        """
        self._pace = Pace() if pace is None else pace
        self._panels = WirePanels(plan, self._pace)
        self._counter = StepCounter(len(plan.links), self._pace.step, start)
        self._start, self._clock, self._most_rows = start, clock or SteadyClock().time, most_rows
        self._amended: list[tuple[NDArray[Any], int]] = []
        self._sent = 0.0
        super().__init__(path, name, [Notice(0.0, "INFO", introduction(plan))])

    def add(self, rows: NDArray[Any]) -> None:
        """Record a block of `RECORD` rows, which must not change afterwards."""
        if len(rows):
            self._append(rows, len(rows), self._most_rows, 0.0)

    def follow(self, journal: WireJournal) -> None:
        """Record the rows of a journal and its events from now on."""
        journal.listeners.append(self.add)
        journal.amendment_listeners.append(self.amend)
        journal.event_listeners.append(lambda time, line: self.note(time, level_of(line), line))

    def note(self, time: float, level: str, text: str) -> None:
        """Add a line to the events, at a time in seconds since 1970; level: INFO, WARN or ERROR."""
        with self._changed:
            if self.failure is None:
                self._notes.append(Notice(self._elapsed(time), level, text))

    def amend(self, rows: NDArray[Any], fate: int) -> None:
        """Change the fate of rows that were added."""
        with self._changed:
            if self.failure is None:
                self._amended.append((rows, fate))

    def _elapsed(self, time: float) -> float:
        return max(0.0, time - self._start)

    def _steps(self, chunks: list[NDArray[Any]]) -> Iterator[WireSteps]:
        with self._changed:
            amended, self._amended = self._amended, []
        now = self._clock()
        for rows in chunks:
            yield from self._counter.add(rows)
        for rows, fate in amended:
            self._counter.amend(rows, fate)
        if self._last or now - self._sent >= _BATCH:
            self._sent = now
            yield from self._counter.close(now - _LATE)
            if self._last:
                yield from self._counter.finish()


PICTURE_SIZE = (1200, 720)
"""Width and height of a picture of a wire, in pixels."""
_WRITE_SECONDS = 60.0  # for the disk to take a part of what is recorded
_MOST_STEPS = 4096  # that may wait for the disk


def replay_wire(folder: Path, path: Path) -> Path:
    """Write the recording of the latest start of a wire to a path, from the journal in its folder; returns the path.

    Raises UsageError if the folder cannot be read, if nothing has crossed the wire, or if the path cannot be written: also if
    Rerun never returns from a disk that is full.
    """
    plan, history = load_wire(folder / WIRE_FILE), WireHistory.read(folder / JOURNAL_FOLDER)
    pace = Pace.of_length(_seconds(folder, history))
    panels, counter = WirePanels(plan, pace), StepCounter(len(plan.links), pace.step, history.began)
    links = {link.name: link.number for link in plan.links}
    recording = _Replay(path, folder.resolve().name, panels, [*_notices(plan, history)])
    with closing(recording):
        for table in journal_tables(folder, history.start):
            for steps in counter.add(records_of(table, links)):
                recording.add(steps)
        for steps in counter.finish():
            recording.add(steps)
    if recording.failure is not None:
        world().disk.remove(path, missing_ok=True)
        raise UsageError(f"{path} cannot be written ({recording.failure})")
    return path


def wire_seconds(folder: Path) -> float:
    """The time from the latest start of a wire to its last message. Raises UsageError as `replay_wire` does."""
    return _seconds(folder, WireHistory.read(folder / JOURNAL_FOLDER))


def _seconds(folder: Path, history: WireHistory) -> float:
    ends: list[float] = [
        pc.max(table["time"]).as_py() for table in journal_tables(folder, history.start) if table.num_rows
    ]
    if not ends:
        raise UsageError(f"{folder} shows nothing: no message came to the wire since its latest start")
    return max(0.0, max(ends) - history.began)


@final
class _Replay(_WireRecording[WireSteps]):
    """Writes the recording of a wire that is over. A disk that is slow or full cannot hang what reads the journal."""

    def __init__(self, path: Path, name: str, panels: WirePanels, notes: Sequence[Notice]) -> None:
        self._panels = panels
        super().__init__(path, name, notes, _WRITE_SECONDS)

    def add(self, steps: WireSteps) -> None:
        """Record further steps; waits for a file that is far behind."""
        self._append(steps, len(steps.counts), _MOST_STEPS, _WRITE_SECONDS)

    def _steps(self, chunks: list[WireSteps]) -> list[WireSteps]:
        return chunks


def _notices(plan: WirePlan, history: WireHistory) -> Iterator[Notice]:
    """The lines of the events panel that do not come from messages."""
    again = "" if history.start == 1 else f"; start {history.start} in this folder"
    yield Notice(0.0, "INFO", introduction(plan) + again)
    for event in history.noted:
        yield Notice(max(0.0, event.time - history.began), level_of(event.line), event.line)
