"""The recording of a run: a file, written so that it can delay the run by a few seconds at most.

Rerun may block when a disk is slow or full. So the run only appends to a list, and a thread turns slots into columns
and writes the file. Viewers read the file as it grows; the run does not know of them.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeVar, final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.results.folder import private_file
from evedrop.show.view.events import Event, introduction
from evedrop.show.view.panel_set import PanelSet
from evedrop.show.view.scene import PeerSlots, Scene, SceneSlots, Shown
from evedrop.system.output import warn

__all__ = ["PeerSlots", "RecordingThread", "Scene", "SceneSlots", "Shown", "ViewRecording"]

_APPLICATION = "evedrop"
_PERIOD = 0.1  # seconds between batches at most
_MOST_SLOTS = 1024  # in a batch
_MOST_WAITING = 20_000  # slots that the file may be behind before the run waits for it
FILE_TIMEOUT = 5.0
"""Seconds that a run waits for the file before it continues without one.

Public, because the tests of whole runs, which begin recordings deep inside, allow a busy machine more.
"""

Chunk = TypeVar("Chunk")
Note = TypeVar("Note")


class RecordingThread(ABC, Generic[Chunk, Note]):
    """A thread that writes a recording to `path`. Neither disk nor panels can make any method raise: see `failure`.

    A subclass says what is recorded. The constructor calls `_layout`, the thread `_style` and then `_send`.
    """

    def __init__(self, path: Path, name: str, notes: Sequence[Note], patience: float | None = None) -> None:
        """name: identifies the recording: recordings of the same name are shown as one. notes: the first lines.

        patience: how long the file may take to begin, for a batch, and to end, in seconds; by default `FILE_TIMEOUT`.
        """
        self._patience = FILE_TIMEOUT if patience is None else patience
        self.failure: str | None = None
        """Why there is no recording on disk, or an incomplete one."""
        self._waiting: list[Chunk] = []
        self._waiting_size = 0
        self._notes = list(notes)
        self._closing = False
        self._last = False
        """Whether the present call of `_send` is the last one."""
        self._changed = threading.Condition()
        self._file = rr.RecordingStream(_APPLICATION, recording_id=name)
        begun = threading.Event()
        self._writer = threading.Thread(target=self._record, args=(path, begun), name="recording", daemon=True)
        try:
            self._blueprint = self._layout()
        except Exception as error:
            self._give_up(str(error))
            begun.set()
        self._writer.start()
        if not begun.wait(self._patience):
            self._give_up("the file could not be written")

    @abstractmethod
    def _layout(self) -> rrb.Blueprint:
        """The views."""

    @abstractmethod
    def _style(self, to: rr.RecordingStream) -> None:
        """Record names, colours and other styles, once."""

    @abstractmethod
    def _send(self, chunks: list[Chunk], notes: list[Note], to: rr.RecordingStream) -> bool:
        """Record what came since the last call, about ten times a second; returns whether anything was recorded."""

    def _append(self, chunk: Chunk, size: int, most: int, patience: float) -> None:
        """Append to the list. With more than `most` in it, wait, and after `patience` seconds do without a recording."""
        with self._changed:
            if self._waiting_size > most:
                in_time = self._changed.wait_for(lambda: self._waiting_size <= most, patience)
                if not in_time:
                    self._give_up("the disk did not keep up with the run")
            if self.failure is None:
                self._waiting.append(chunk)
                self._waiting_size += size
                self._changed.notify_all()

    def close(self) -> bool:
        """Finish the file, within a time limit.

        True if the interpreter can now exit normally. Otherwise Rerun hangs, and only os._exit ends the process.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._writer.join(self._patience)
        if self._writer.is_alive():
            self._give_up("the disk did not keep up with the run")
        return self.failure is None

    def _give_up(self, why: str) -> None:
        if self.failure is None:
            self.failure = f"the recording is incomplete: {why}; free some space, or choose another folder"

    def _record(self, path: Path, begun: threading.Event) -> None:
        """Begin the file and write it to its end. Rerun never returns from a file that cannot even be begun."""
        if self.failure is None:
            try:
                self._file.save(private_file(path), default_blueprint=self._blueprint)
                self._style(self._file)
            except Exception as error:
                self._give_up(str(error))
        begun.set()
        self._write()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._waiting_size >= _MOST_SLOTS, _PERIOD)
                chunks, self._waiting, self._waiting_size = self._waiting, [], 0
                notes, self._notes = self._notes, []
                self._last = self._closing
                self._changed.notify_all()
            try:
                self._put(chunks, notes)
            except Exception as error:  # if the thread died, the run would wait for it
                self._give_up(repr(error))
            if self._last:
                break
        if self.failure is None:
            self._file.disconnect()

    def _put(self, chunks: list[Chunk], notes: list[Note]) -> None:
        if self.failure is not None or not self._send(chunks, notes, self._file):
            return
        try:
            # When Rerun cannot write a file any more, the only sign is that it never finishes.
            self._file.flush(timeout_sec=self._patience)
        except RuntimeError:
            self._give_up("the file could not be written")


@final
class ViewRecording(RecordingThread[SceneSlots, Event]):
    """Writes the recording of one run."""

    def __init__(self, path: Path, scene: Scene, warn: Callable[[str], None] = warn) -> None:
        """warn: tells the user about a panel that is left out; called from any thread."""
        self._scene, self._warn = scene, warn
        super().__init__(path, scene.run, introduction(scene))

    def add(self, slots: SceneSlots) -> None:
        """Record the next slots. Waits only for a disk that is thousands of slots behind, and for a few seconds at most."""
        if slots.count:
            self._append(slots, slots.count, _MOST_WAITING, self._patience)

    def note(self, k: int, level: str, text: str) -> None:
        """Add a line to the events: level is INFO, WARN or ERROR."""
        with self._changed:
            self._notes.append(Event(k, level, text))

    def _layout(self) -> rrb.Blueprint:
        self._panels = PanelSet(self._scene, self._warn)
        return self._panels.layout()

    def _style(self, to: rr.RecordingStream) -> None:
        self._panels.send_styles(to)

    def _send(self, chunks: list[SceneSlots], notes: list[Event], to: rr.RecordingStream) -> bool:
        if chunks:
            self._panels.send(SceneSlots.joined(chunks), to)
        if notes:
            self._panels.send_notes(notes, to)
        return bool(chunks or notes)
