"""The files of the view while a run is in progress: how a viewer that comes late gets a few large chunks.

Rerun works on chunks, and its work grows with their number, so the recording has large ones. A viewer should not wait for them.
So the newest slots are in further files, each with smaller chunks than the one before: the last file has every slot in the small
chunks in which it became known. A file of positions says which parts, one from each file, make up the whole recording. A viewer
reads these parts, and then the last file as it grows. The files are in the folder `unfinished`, which a run removes when it is
complete; a viewer that reads them keeps them open. Rerun is not imported here.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import final

from evedrop.results.folder import UNFINISHED, make_private
from evedrop.system.disk import write_all
from evedrop.system.world import world

_NAME = "view"
_NUMBER = struct.Struct("<Q")

Span = tuple[int, int]
"""A part of a file: its first byte, and the byte after its last one."""


def chunk_file(recording: Path, number: int) -> Path:
    """A file beside a recording; the larger its number (from 1 on), the smaller its chunks."""
    return recording.parent / UNFINISHED / f"{_NAME}-{number}.rrd"


def _positions_file(recording: Path) -> Path:
    return recording.parent / UNFINISHED / f"{_NAME}.positions"


@final
class WrittenPositions:
    """The file of positions, which grows by a line of numbers for each batch. Raises OSError."""

    def __init__(self, recording: Path, files: int) -> None:
        """Create the file; files: their number, the recording included. A reader looks for it once there is a recording."""
        make_private(recording.parent / UNFINISHED)
        self._file = world().disk.open(_positions_file(recording), "wb")
        write_all(self._file, _NUMBER.pack(files))

    def append(self, spans: Sequence[Span]) -> None:
        """Say which part of each file to read, the recording first."""
        write_all(self._file, b"".join(_NUMBER.pack(at) for span in spans for at in span))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


@final
class LiveFiles:
    """The reader's side: the descriptors of a recording and of the files beside it, if there are any."""

    def __init__(self, recording: Path) -> None:
        """Raises OSError if there is no recording."""
        self.descriptors = [os.open(recording, os.O_RDONLY | os.O_CLOEXEC)]
        self._positions: int | None = None
        with contextlib.suppress(OSError):  # a recording by itself: it is complete, or grows by chunks of one size
            self._open_others(recording)

    def _open_others(self, recording: Path) -> None:
        positions = os.open(_positions_file(recording), os.O_RDONLY | os.O_CLOEXEC)
        (files,) = _NUMBER.unpack(os.pread(positions, _NUMBER.size, 0).ljust(_NUMBER.size, b"\0"))
        others = list[int]()
        try:
            for number in range(1, files):
                others.append(os.open(chunk_file(recording, number), os.O_RDONLY | os.O_CLOEXEC))
        except OSError:  # removed meanwhile: the recording is complete
            for descriptor in (positions, *others):
                os.close(descriptor)
            return
        self.descriptors += others
        self._positions = positions

    @property
    def spans(self) -> list[Span] | None:
        """The part of each file that is to be read now; None for a recording by itself. Empty before anything was recorded."""
        if self._positions is None:
            return None
        line = 2 * len(self.descriptors) * _NUMBER.size
        lines = (os.fstat(self._positions).st_size - _NUMBER.size) // line
        if lines < 1:
            return []
        at = [
            number
            for (number,) in _NUMBER.iter_unpack(os.pread(self._positions, line, _NUMBER.size + (lines - 1) * line))
        ]
        return [*zip(at[::2], at[1::2], strict=True)]
