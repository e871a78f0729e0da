"""The folder for the briefs of a run, which hold keys and passwords; and its end, even if the launcher is killed.

A shell that holds the other end of a pipe to the launcher removes the folder when the launcher is dead. The launcher also holds
a lock in the folder, which the system takes from the dead: if the shell was killed too, the next run finds a folder whose lock
is free, and removes it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from evedrop.environment import own_environment
from evedrop.errors import UsageError

_PREFIX = "evedrop-"
_LOCK = "lock"
_GUARD_SECONDS = 5.0
# A process that is still starting may write into the folder while it is removed: then it is removed again.
_GUARD = (
    "while read -r _; do :; done; tries=0; "
    'while [ -e "$1" ] && [ $tries -lt 50 ]; do rm -rf -- "$1" 2>/dev/null || sleep 0.2; tries=$((tries + 1)); done'
)


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """A folder that nobody else may look into, gone after the block. Raises UsageError if none can be made."""
    try:
        where = Path(tempfile.gettempdir()).absolute()
        _sweep(where)
        folder = where / f"{_PREFIX}{secrets.token_hex(8)}"
        guard = _guard(folder)
    except OSError as error:
        raise _unmade(error) from error
    try:
        with _locked(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _dismiss(guard)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Make the folder, and hold the lock in it."""
    try:
        folder.mkdir(mode=0o700)
        lock = (folder / f"{_LOCK}.new").open("w")
    except OSError as error:
        raise _unmade(error) from error
    with lock:
        with contextlib.suppress(OSError):  # of a file system without locks, where nothing is swept then
            fcntl.flock(lock, fcntl.LOCK_EX)
            os.replace(lock.name, folder / _LOCK)  # nobody finds one that is not locked
        yield


def _unmade(error: OSError) -> UsageError:
    return UsageError(f"no temporary folder can be made ({error.strerror}); set TMPDIR to one")


def _guard(folder: Path) -> subprocess.Popen[bytes]:
    """Start the shell that removes the folder when we are dead; before there is a folder, so that there never is one without."""
    return subprocess.Popen(
        ["/bin/sh", "-c", _GUARD, "sh", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env=own_environment(),
    )


def _dismiss(guard: subprocess.Popen[bytes]) -> None:
    """Let the shell end, which finds nothing to remove."""
    assert guard.stdin is not None  # noqa: S101 - as it was started
    guard.stdin.close()
    try:
        guard.wait(_GUARD_SECONDS)
    except subprocess.TimeoutExpired:
        guard.kill()
        guard.wait()


def _sweep(where: Path) -> None:
    """Remove the folders that were ours and whose launcher is dead."""
    for folder in where.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / _LOCK).open("r+") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
