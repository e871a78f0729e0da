"""The folder for the briefs of a run, which hold keys and passwords; and the end of those whose launcher was killed.

Whoever makes one holds a lock in it, which the system takes from the dead. So a folder whose lock is free is nobody's.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from emulator.errors import UsageError

_PREFIX = "evedrop-"
_LOCK = "lock"


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """A folder that nobody else may look into, gone after the block. Raises UsageError if none can be made."""
    _sweep(Path(tempfile.gettempdir()))
    try:
        made = tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True)
    except OSError as error:
        raise UsageError(f"no temporary folder can be made ({error.strerror}); set TMPDIR to one") from error
    with made as name, (Path(name) / f"{_LOCK}.new").open("w") as lock:
        with contextlib.suppress(OSError):  # of a file system without locks, where nothing is swept then
            fcntl.flock(lock, fcntl.LOCK_EX)
            os.replace(lock.name, Path(name) / _LOCK)  # nobody finds one that is not locked
        yield Path(name)


def _sweep(where: Path) -> None:
    """Remove the folders that were ours and whose launcher is dead."""
    for folder in where.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / _LOCK).open("r+") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
