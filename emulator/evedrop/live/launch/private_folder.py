"""The folder for the briefs of a run, which hold keys and passwords; it is removed even if the launcher is killed.

A shell that holds the other end of a pipe to the launcher removes the folder when the launcher is dead. The launcher also
holds a lock in the folder, which the system releases when the launcher dies: if the shell was killed, too, the next run
finds the folder unlocked, and removes it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.live.network.endpoint import can_be_socket
from evedrop.names import ROUTER
from evedrop.system.world import world

_PREFIX = "evedrop-"
_TOKEN_BYTES = 8
_NAME = re.compile(rf"{_PREFIX}[0-9a-f]{{{2 * _TOKEN_BYTES}}}")
_LOCK = "lock"
_MODE = 0o700
_SHORT = Path("/tmp")  # noqa: S108 - the folder in it is as private as one elsewhere
"""Where sockets are if the paths in the folder for temporary files cannot be those of sockets."""


@contextlib.contextmanager
def private_folder(where: Path | None = None) -> Iterator[Path]:
    """A folder that only this user can read, removed after the block. Raises UsageError if it cannot be made.

    where: the folder to make it in; the one for temporary files by default.
    """
    with contextlib.ExitStack() as stack:
        try:
            where = (where or world().temporary_folder()).absolute()
            _sweep(where)
            folder = where / f"{_PREFIX}{world().token(_TOKEN_BYTES).hex()}"
            stack.enter_context(world().process.removed_with_it(folder))
        except OSError as error:
            raise _unmade(error) from error
        try:
            with _locked(folder):
                yield folder
        finally:
            world().disk.remove_tree(folder, ignore_errors=True)


@contextlib.contextmanager
def socket_folder(private: Path) -> Iterator[Path]:
    """The private folder of a run, or another one, if a path in it is too long for a socket. Raises UsageError."""
    if can_be_socket(str(private / ROUTER)):
        yield private
        return
    with private_folder(_SHORT) as folder:
        yield folder


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Make the folder, and hold the lock in it."""
    try:
        world().disk.make_folder(folder, _MODE)
        unfinished = folder / f"{_LOCK}.new"
        lock = world().disk.open(unfinished, "wb")
    except OSError as error:
        raise _unmade(error) from error
    with lock:
        with contextlib.suppress(OSError):  # on a file system without locks, nothing is swept
            fcntl.flock(lock, fcntl.LOCK_EX)
            world().disk.replace(unfinished, folder / _LOCK)  # so that the file never exists unlocked
        yield


def _unmade(error: OSError) -> UsageError:
    return UsageError(f"cannot make a temporary folder ({error.strerror}); set TMPDIR to a folder that can be written")


def _sweep(where: Path) -> None:
    """Remove this user's folders whose launcher is dead."""
    for folder in where.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            private = stat.S_ISDIR(status.st_mode) and status.st_mode & 0o777 == _MODE
            if not private or status.st_uid != os.getuid() or not _NAME.fullmatch(folder.name):
                continue  # the user may have made it
            with world().disk.open(folder / _LOCK, "r+b") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                world().disk.remove_tree(folder, ignore_errors=True)
