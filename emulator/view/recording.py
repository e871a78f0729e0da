"""The recording of a run: a file, written so that it can delay the run by a few seconds at most.

Rerun may block when a disk is slow or full. So the run only appends to a list, and a thread turns slots into columns
and writes the file. Viewers read the file as it grows; the run does not know of them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import final

import rerun as rr

from evedrop.output import warn
from evedrop.results.folder import private_file
from evedrop.view.events import Event, introduction
from evedrop.view.panel_set import PanelSet
from evedrop.view.scene import PeerSlots, Scene, SceneSlots, Shown

__all__ = ["PeerSlots", "Scene", "SceneSlots", "Shown", "ViewRecording"]

_APPLICATION = "evedrop"
_PERIOD = 0.1  # seconds between batches at most
_MOST_SLOTS = 1024  # in a batch
_MOST_WAITING = 20_000  # slots that the file may be behind before the run waits for it
_FILE_TIMEOUT = 5.0  # seconds that the run waits for the file before it continues without one


@final
class ViewRecording:
    """Writes the recording of one run to `path`. Neither disk nor panels can make any method raise: see `failure`."""

    def __init__(self, path: Path, scene: Scene, warn: Callable[[str], None] = warn) -> None:
        """warn: tells the user about a panel that is left out; called from any thread."""
        self.failure: str | None = None
        """Why there is no recording on disk, or an incomplete one."""
        self._waiting: list[SceneSlots] = []
        self._waiting_slots = 0
        self._notes = introduction(scene)
        self._closing = False
        self._changed = threading.Condition()
        self._file = rr.RecordingStream(_APPLICATION, recording_id=scene.run)
        try:
            self._panels = PanelSet(scene, warn)
            self._file.save(private_file(path), default_blueprint=self._panels.layout())
            self._panels.send_styles(self._file)
        except Exception as error:
            self._give_up(str(error))
        self._writer = threading.Thread(target=self._write, name="recording", daemon=True)
        self._writer.start()

    def add(self, slots: SceneSlots) -> None:
        """Record the next slots. Waits only for a disk that is thousands of slots behind, and for a few seconds at most."""
        if not slots.count:
            return
        with self._changed:
            if self._waiting_slots > _MOST_WAITING:
                in_time = self._changed.wait_for(lambda: self._waiting_slots <= _MOST_WAITING, _FILE_TIMEOUT)
                if not in_time:
                    self._give_up("the disk did not keep up with the run")
            if self.failure is None:
                self._waiting.append(slots)
                self._waiting_slots += slots.count
                self._changed.notify_all()

    def note(self, k: int, level: str, text: str) -> None:
        """Add a line to the events: level is INFO, WARN or ERROR."""
        with self._changed:
            self._notes.append(Event(k, level, text))

    def close(self) -> bool:
        """Finish the file, within a time limit.

        True if the interpreter can now exit normally. Otherwise Rerun hangs, and only os._exit ends the process.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._writer.join(_FILE_TIMEOUT)
        if self._writer.is_alive():
            self._give_up("the disk did not keep up with the run")
        return self.failure is None

    def _give_up(self, why: str) -> None:
        if self.failure is None:
            self.failure = f"the recording is incomplete: {why}; free some space, or choose another --out"

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._waiting_slots >= _MOST_SLOTS, _PERIOD)
                chunks, self._waiting, self._waiting_slots = self._waiting, [], 0
                notes, self._notes = self._notes, []
                closing = self._closing
                self._changed.notify_all()
            try:
                self._put(chunks, notes)
            except Exception as error:  # if the thread died, the run would wait for it
                self._give_up(repr(error))
            if closing:
                break
        if self.failure is None:
            self._file.disconnect()

    def _put(self, chunks: list[SceneSlots], notes: list[Event]) -> None:
        if self.failure is not None or not (chunks or notes):
            return
        if chunks:
            self._panels.send(SceneSlots.joined(chunks), self._file)
        if notes:
            self._panels.send_notes(notes, self._file)
        try:
            # When Rerun cannot write a file any more, the only sign is that it never finishes.
            self._file.flush(timeout_sec=_FILE_TIMEOUT)
        except RuntimeError:
            self._give_up("the file could not be written")
