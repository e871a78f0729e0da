"""The recording of a run: a file, written in such a way that it cannot delay the run.

Rerun may block when a disk is slow or full. So the run only appends to a list, and a thread turns slots into columns
and writes the file. Viewers read the file as it grows; the run does not know of them.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import final

import numpy as np
import rerun as rr

from evedrop.model.receiver import Flags
from evedrop.results.folder import private_file
from evedrop.view.blueprint import layout
from evedrop.view.column import Column
from evedrop.view.columns import Columns, lines, log_styles
from evedrop.view.events import Event, introduction
from evedrop.view.paths import NOTES
from evedrop.view.scene import Moved, PeerSlots, Scene, SceneSlots, Shown

__all__ = ["PeerSlots", "Scene", "SceneSlots", "Shown", "ViewRecording"]

_APPLICATION = "evedrop"
_PERIOD = 0.1  # seconds between batches, so that a batch is worth its overhead
_MOST_SLOTS = 1024  # in a batch
_MOST_WAITING = 20_000  # slots that the file may be behind before the run waits for it
_FILE_TIMEOUT = 5.0  # seconds that the run waits for the file before it continues without one


@final
class ViewRecording:
    """Writes the recording of one run to `path`. The disk cannot make any method raise: see `failure`."""

    def __init__(self, path: Path, scene: Scene) -> None:
        self.failure: str | None = None
        """Why there is no recording on disk, or an incomplete one."""
        self._scene = scene
        self._columns = Columns(scene)
        self._waiting: list[SceneSlots] = []
        self._waiting_slots = 0
        self._notes = introduction(scene)
        self._closing = False
        self._changed = threading.Condition()
        self._file = _stream(scene)
        try:
            self._file.save(private_file(path), default_blueprint=layout(scene))
            log_styles(self._file, scene)
        except Exception as error:
            self._give_up(str(error))
        self._writer = threading.Thread(target=self._write, name="recording", daemon=True)
        self._writer.start()

    def add(self, slots: SceneSlots) -> None:
        """Record the next slots. Waits only for the disk, and only if that is thousands of slots behind."""
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
        columns = [lines(NOTES, notes)] if notes else []
        if chunks:
            columns = [*self._columns.of(_joined(chunks)), *columns]
        if columns and self.failure is None:
            self._save(columns)

    def _save(self, columns: list[Column]) -> None:
        for column in columns:
            column.send(self._file)
        try:
            # When Rerun cannot write a file any more, the only sign is that it never finishes.
            self._file.flush(timeout_sec=_FILE_TIMEOUT)
        except RuntimeError:
            self._give_up("the file could not be written")


def _stream(scene: Scene) -> rr.RecordingStream:
    return rr.RecordingStream(_APPLICATION, recording_id=scene.run)


def _joined(chunks: list[SceneSlots]) -> SceneSlots:
    if len(chunks) == 1:
        return chunks[0]
    peers = {
        name: PeerSlots(
            x_hat=np.concatenate([chunk.peers[name].x_hat for chunk in chunks]),
            P=np.concatenate([chunk.peers[name].P for chunk in chunks]),
            action=np.concatenate([chunk.peers[name].action for chunk in chunks]),
            squared_error=np.concatenate([chunk.peers[name].squared_error for chunk in chunks]),
            trace=np.concatenate([chunk.peers[name].trace for chunk in chunks]),
            expected_trace=np.concatenate([chunk.peers[name].expected_trace for chunk in chunks]),
        )
        for name in chunks[0].peers
    }
    return SceneSlots(
        chunks[0].first,
        np.concatenate([chunk.x for chunk in chunks]),
        np.concatenate([chunk.nu for chunk in chunks]),
        peers,
        _joined_moves([chunk.moved for chunk in chunks if chunk.moved is not None]),
        _joined_packets(chunks),
    )


def _joined_packets(chunks: list[SceneSlots]) -> Flags | None:
    if all(chunk.sent is None for chunk in chunks):
        return None
    return np.concatenate([np.ones(chunk.count, np.bool_) if chunk.sent is None else chunk.sent for chunk in chunks])


def _joined_moves(moves: list[Moved]) -> Moved | None:
    if not moves:
        return None
    return Moved(
        np.concatenate([one.values for one in moves]),
        {path: np.concatenate([one.curves[path] for one in moves], axis=1) for path in moves[0].curves},
    )
