"""The recording of a run in real time: written in small chunks at once, and in larger ones as soon as these are full.

Source: `live_files`, how viewers read them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import final

import rerun as rr

from evedrop.results.folder import private_file
from evedrop.show.view.column import Column, SlotTimes, joined
from evedrop.show.view.live_files import Span, WrittenPositions, chunk_file

_FACTOR = 10  # between the slots in the chunks of one file and the next
_LEAST, _MOST = 1000, 4000  # slots in a chunk of the recording
_SECONDS = 20.0  # in a chunk of the recording, if that is neither less than the least nor more than the most
_MERGED = 5  # batches at least that are merged into one chunk


def chunk_sizes(pace: float, period: float) -> list[int]:
    """The slots in the chunks of each file but the last, from the recording's on; none for a run as fast as possible.

    pace: seconds per slot; period: seconds between two batches, each of which is a chunk of the last file.
    """
    if pace <= 0:
        return []
    batch, sizes = max(1.0, period / pace), list[int]()
    size = int(min(_MOST, max(_LEAST, _SECONDS / pace)))
    while size >= _MERGED * batch:
        sizes.append(size)
        size //= _FACTOR
    return sizes


@final
class StagedChunks:
    """The files beside a recording that is being written. Any method may raise OSError, or RuntimeError from Rerun."""

    def __init__(
        self,
        path: Path,
        recording: rr.RecordingStream,
        sizes: list[int],
        stream: Callable[[], rr.RecordingStream],
        times: SlotTimes,
    ) -> None:
        """Create the files, before the recording itself; recording: written to `path`. sizes: as by `chunk_sizes`.

        stream: makes another stream of the same recording. times: of its slots.
        """
        self._times = times
        self._path, self._sizes = path, sizes
        self._positions = WrittenPositions(path, len(sizes) + 1)
        self._streams = [recording]
        self._descriptors = list[int]()
        for number in range(1, len(sizes) + 1):
            file = private_file(chunk_file(path, number))
            self._streams.append(stream())
            self._streams[-1].save(file)
            self._descriptors.append(os.open(file, os.O_RDONLY | os.O_CLOEXEC))
        self._starts = [0] * len(self._streams)
        self._waiting: list[list[Column]] = [[] for _ in sizes]
        self._reached = [0] * len(sizes)

    def begin(self, patience: float) -> None:
        """Let viewers read, once the recording has its styles."""
        self._descriptors.insert(0, os.open(self._path, os.O_RDONLY | os.O_CLOEXEC))
        for stream in self._streams:
            stream.flush(timeout_sec=patience)
        self._starts[1:] = [self._size(number) for number in range(1, len(self._streams))]  # the head of each file
        self._append()

    def put(self, column: Column) -> None:
        """Record a column in the smallest chunks."""
        column.send(self._streams[-1], self._times)
        self._waiting[-1].append(column)

    def pass_on(self, slots: int, patience: float, last: bool) -> None:
        """Finish a batch, and merge the chunks that are full; slots: so far. last: no batch follows, so merge all."""
        self._streams[-1].flush(timeout_sec=patience)
        for number in reversed(range(len(self._sizes))):
            if last or slots - self._reached[number] >= self._sizes[number]:
                merged = joined(self._waiting[number])
                for column in merged:
                    column.send(self._streams[number], self._times)
                self._streams[number].flush(timeout_sec=patience)
                if number:
                    self._waiting[number - 1] += merged
                self._waiting[number], self._reached[number] = [], slots
                self._starts[number + 1] = self._size(number + 1)
            slots = self._reached[number]
        self._append()

    def close(self) -> None:
        """Close the files; the recording is complete."""
        self._append()
        self._positions.close()
        for stream in self._streams[1:]:
            stream.disconnect()
        for descriptor in self._descriptors:
            os.close(descriptor)

    def _append(self) -> None:
        spans: list[Span] = [(start, self._size(number)) for number, start in enumerate(self._starts)]
        self._positions.append(spans)

    def _size(self, number: int) -> int:
        return os.fstat(self._descriptors[number]).st_size  # its folder may have been moved
