"""A folder held by its descriptor and not by its name, so that it may be renamed while a run writes to it."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from pathlib import Path
from typing import final

_F_GETPATH = 50  # of macOS; Python has no name for it before 3.9, and none on Linux


@final
class HeldFolder:
    """An open folder."""

    def __init__(self, path: Path) -> None:
        """Open the folder. Raises OSError if it cannot be opened."""
        self.first = path
        """Its path when it was opened."""
        self._descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)

    @property
    def now(self) -> Path:
        """Its current path. Raises FileNotFoundError if it was removed."""
        if self._is(self.first):
            return self.first
        moved = self._found()
        if moved is not None and self._is(moved):
            return moved
        raise FileNotFoundError(errno.ENOENT, "the folder was removed while the run went on", str(self.first))

    def _is(self, path: Path) -> bool:
        try:
            return os.path.samestat(path.stat(), os.fstat(self._descriptor))
        except OSError:
            return False

    def _found(self) -> Path | None:
        """The folder's path according to the system."""
        try:
            if sys.platform == "darwin":
                return Path(os.fsdecode(fcntl.fcntl(self._descriptor, _F_GETPATH, bytes(1024)).rstrip(b"\0")))
            return Path(os.readlink(f"/proc/self/fd/{self._descriptor}"))
        except OSError:
            return None

    def close(self) -> None:
        """Close the folder."""
        os.close(self._descriptor)
