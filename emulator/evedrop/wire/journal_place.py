"""The folder of a running wire's journal: locked for this process, with a file that says when the wire was last alive.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import final

from evedrop.results.folder import make_private
from evedrop.wire.journal_reader import UNFINISHED
from evedrop.wire.journal_recovery import locked


@final
class JournalPlace:
    """A journal's folder, which this process alone writes to until it calls `close`."""

    def __init__(self, journal: Path, tell: Callable[[str], None]) -> None:
        """Make the folder, and lock it. tell: for what the user must know.

        Raises UsageError if another wire uses the folder, and OSError if it cannot be written.
        """
        self._journal, self._tell = journal, tell
        self.incomplete_since: float | None = None
        """When something could not be written for the first time, in seconds since 1970; None: the disk always had room."""
        self.removed: Path | None = None
        """This folder, or the one inside it, if it was removed or moved since the wire began, as of the last `poll`."""
        self.unfinished = journal / UNFINISHED
        """The folder inside it for records that are not yet in a Parquet file."""
        make_private(self.unfinished)
        self._lock = locked(journal)
        self._alive: int | None = None

    def begin(self) -> None:
        """Begin to note that the wire is alive, once an earlier start has been recovered. Raises OSError."""
        self._alive = os.open(self.unfinished / "alive", os.O_WRONLY | os.O_CREAT, 0o600)
        self.beat()

    def beat(self) -> None:
        """Note that the wire is alive now. Raises OSError."""
        assert self._alive is not None  # noqa: S101 - it has begun
        os.pwrite(self._alive, struct.pack("<d", time.time()), 0)

    def poll(self) -> None:
        """Check whether the folder is still there, and report at once if it is not."""
        if self.removed is not None:
            return
        self.removed = self._missing()
        if self.removed is not None:
            self.incomplete_since = self.incomplete_since or time.time()
            self._tell(
                f"{self.removed} was removed or moved while the wire runs, so the wire no longer has a journal; it goes on; end "
                "it, and start it again"
            )

    def miss(self, error: OSError) -> None:
        """Note that something could not be written, and tell so the first time."""
        self.poll()
        if self.incomplete_since is None:
            self.incomplete_since = time.time()
            at = time.strftime("%H:%M:%S", time.localtime(self.incomplete_since))
            self._tell(
                f"the journal is incomplete from {at} on, because {self._journal} cannot be written ({error.strerror}); the wire "
                "goes on; make room"
            )

    def _missing(self) -> Path | None:
        """The folder, or the one inside it, that was removed, moved or replaced."""
        try:
            if not os.path.samestat(os.fstat(self._lock), os.stat(self._journal)):
                return self._journal
            return self.unfinished if self._alive is not None and os.fstat(self._alive).st_nlink == 0 else None
        except (FileNotFoundError, NotADirectoryError):
            return self._journal
        except OSError:  # a disk that does not answer may answer later
            return None

    def close(self) -> None:
        """Let another wire use the folder."""
        for descriptor in (self._alive, self._lock):
            if descriptor is not None:
                os.close(descriptor)
