"""Makes the recording of a wire from its journal.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import final

import pyarrow.compute as pc
import rerun as rr
import rerun.blueprint as rrb

from evedrop.errors import UsageError
from evedrop.results.wire_folder import WIRE_FILE
from evedrop.show.view.recording import RecordingThread
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_part import records_of
from evedrop.wire.journal_reader import JOURNAL_FOLDER, journal_tables
from evedrop.wire.notices import Notice, introduction, level_of
from evedrop.wire.panels import Pace, WirePanels
from evedrop.wire.plan import WirePlan
from evedrop.wire.step_counts import StepCounter, WireSteps

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
    ends = [pc.max(table["time"]).as_py() for table in journal_tables(folder, history.start) if table.num_rows]
    if not ends:
        raise UsageError(f"{folder} shows nothing: no message came to the wire since its latest start")
    pace = Pace.of_length(max(0.0, max(ends) - history.began))
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
        path.unlink(missing_ok=True)
        raise UsageError(f"{path} cannot be written ({recording.failure})")
    return path


@final
class _Replay(RecordingThread[WireSteps, Notice]):
    """Writes the recording of a wire that is over. A disk that is slow or full cannot hang what reads the journal."""

    def __init__(self, path: Path, name: str, panels: WirePanels, notes: Sequence[Notice]) -> None:
        self._panels = panels
        super().__init__(path, name, notes, _WRITE_SECONDS)

    def add(self, steps: WireSteps) -> None:
        """Record further steps; waits for a file that is far behind."""
        self._append(steps, len(steps.counts), _MOST_STEPS, _WRITE_SECONDS)

    def _layout(self) -> rrb.Blueprint:
        return self._panels.layout()

    def _style(self, to: rr.RecordingStream) -> None:
        self._panels.style(to)

    def _send(self, chunks: list[WireSteps], notes: list[Notice], to: rr.RecordingStream) -> bool:
        self._panels.notes(notes, to)
        for steps in chunks:
            self._panels.send(steps, to)
        if self._last:
            self._panels.end(to)
        return bool(chunks or notes or self._last)


def _notices(plan: WirePlan, history: WireHistory) -> Iterator[Notice]:
    """The lines of the events panel that do not come from messages."""
    again = "" if history.start == 1 else f"; start {history.start} in this folder"
    yield Notice(0.0, "INFO", introduction(plan) + again)
    for event in history.noted:
        yield Notice(max(0.0, event.time - history.began), level_of(event.line), event.line)
