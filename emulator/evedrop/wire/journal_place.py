"""The folder of a wire's journal: its lock, the time when the wire was last alive, and what could not be written.

Source: docs/wire/results.md, the journal, a wire that starts again.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
import time
from collections.abc import Callable, Iterator
from io import FileIO
from pathlib import Path
from typing import final

from evedrop.errors import UsageError
from evedrop.results.folder import make_private
from evedrop.system.files import try_lock
from evedrop.system.waiting import SteadyClock, wait_until
from evedrop.system.world import world

JOURNAL_FOLDER = "journal"
"""The folder inside a wire's folder that contains its journal."""
UNFINISHED = "unfinished"
"""The folder inside that one for records that are not yet in a Parquet file."""
_PATIENCE, _STEP = 1.0, 0.01  # seconds: who reads the folder has it locked for an instant


@final
class JournalPlace:
    """A journal's folder, which this process alone writes to until it calls `close`."""

    def __init__(self, journal: Path, tell: Callable[[str], None]) -> None:
        """Make the folder, and lock it. tell: for what the user must know.

        Raises UsageError if another wire uses the folder, and OSError if it cannot be written.
        """
        self._tell = tell
        self.clock = SteadyClock()
        """The clock of all times in the journal of this start."""
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
        self._alive.write(struct.pack("<d", self.clock.time()))

    def poll(self) -> None:
        """Check whether the folder is still there, and report at once if it is not."""
        with self._telling:
            if self.removed is not None:
                return
            self.removed = self._lost()
            if self.removed is not None:
                self.incomplete_since = self.incomplete_since or self.clock.time()
                self._tell(
                    f"{self.removed} was removed or moved while the wire runs, so the wire no longer has a journal; it goes on; "
                    "end it, and start it again"
                )

    def miss(self, error: OSError) -> None:
        """Note that something could not be written, and tell so the first time."""
        with self._telling:
            self.poll()
            if self.incomplete_since is None:
                self.incomplete_since = self.clock.time()
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
    if not wait_until(lambda: try_lock(descriptor), _PATIENCE, _STEP):
        world().disk.let_go(descriptor)
        raise UsageError(f"another wire writes to {folder.parent}; end it, or give another folder")
    return descriptor


def last_beat(unfinished: Path) -> float:
    """The latest time that a wire noted while it ran; 0 if it noted none."""
    with contextlib.suppress(OSError, struct.error):
        beat: float = struct.unpack("<d", (unfinished / "alive").read_bytes())[0]
        return beat
    return 0.0


def part_names(journal: Path) -> list[str]:
    """The names of all parts of a journal, such as 001-0002 for the second part of the first start, in order."""
    # In this order: a running wire makes the Parquet file of a part before it removes the part's rows.
    names_ = {path.stem for path in (*(journal / UNFINISHED).glob("*.rows"), *journal.glob("*.parquet"))}
    parts = [name for name in names_ if re.fullmatch(r"\d{3,}-\d{4,}", name)]  # a user may keep files of others there
    return sorted(parts, key=lambda name: [int(number) for number in name.split("-")])


def parquet_path(journal: Path, name: str) -> Path:
    """The Parquet file of a part."""
    return journal / f"{name}.parquet"


def start_of(name: str) -> int:
    """The number of the start that made a part."""
    return int(name.partition("-")[0])
