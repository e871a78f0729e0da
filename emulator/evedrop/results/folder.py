"""The results folder and its files, accessible only to the user who started the run.

Results contain the seed, the truth and, during a run, the operator's password. A folder therefore has the mode 0700 and a
file 0600 from its creation on, whatever the umask is.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import final

from evedrop.errors import RunError, UsageError
from evedrop.system.files import shown
from evedrop.system.signals import leave_after
from evedrop.system.world import world

STATES = "states.csv"
"""The file in a results folder if its states were given."""
UNFINISHED = "unfinished"
"""The folder inside a results folder that contains what only a run in progress needs, such as unfinished tables."""


def default_folder(scenario: str | Path) -> Path:
    """The default name of a results folder: `runs/<scenario>-<time>` in the current folder."""
    stem = Path(scenario).name.removesuffix(".toml")
    return Path("runs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"


def claimed(wanted: Path) -> Path:
    """Make a new folder of that name, with a number appended if the name is taken, without races. Raises UsageError."""
    for number in itertools.count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        try:
            make_private(folder, exist_ok=False)
        except FileExistsError as error:
            if not folder.parent.is_dir():
                raise _unusable(folder, "a part of it is a file") from error
            continue
        except OSError as error:
            raise _unusable(folder, str(error.strerror)) from error
        return folder
    raise AssertionError  # numbers never run out


@contextlib.contextmanager
def results_folder(out: str | Path | None, scenario: str | Path) -> Iterator[Path]:
    """The folder for results: `out`, or a new one named after the scenario, which is removed if it is still empty."""
    if out is not None:
        yield Path(out)
        return
    folder = claimed(default_folder(scenario))

    def remove_empty() -> None:
        with contextlib.suppress(OSError):
            folder.rmdir()
            folder.parent.rmdir()

    try:
        with leave_after(remove_empty):
            yield folder
    finally:
        remove_empty()


def _unusable(folder: Path, why: str) -> UsageError:
    return UsageError(f"{shown(folder)} cannot be written ({why}); give another folder")


_FOLDER_MODE = 0o700


def new_folder(folder: Path) -> Path:
    """Create a results folder, or use an empty one, and make it private to this user.

    Raises UsageError if it is not empty, belongs to another user, or cannot be written.
    """
    if shown(folder) != str(folder):
        raise UsageError(f"{shown(folder)} is not a name in UTF-8, which results and messages are; give another folder")
    try:
        make_private(folder)
        _narrow(folder)
        if any(folder.iterdir()):
            raise UsageError(f"{folder} is not empty; give another folder, or empty it")
    except NotADirectoryError as error:
        raise UsageError(f"{folder}: a part of it is a file; give another folder") from error
    except FileExistsError as error:
        raise UsageError(f"{folder} is a file; give another folder") from error
    except OSError as error:
        raise UsageError(f"{folder} cannot be written ({error.strerror}); give another folder") from error
    return folder


def make_private(folder: Path, exist_ok: bool = True) -> None:
    """Create a folder and its missing parents, for this user only. Raises OSError as `Path.mkdir` does."""
    for missing in reversed([parent for parent in folder.parents if not parent.exists()]):
        world().disk.make_folder(missing, _FOLDER_MODE, exist_ok=True)
    world().disk.make_folder(folder, _FOLDER_MODE, exist_ok=exist_ok)


def _narrow(folder: Path) -> None:
    """Remove the rights of all other users from an existing folder. Raises UsageError if it belongs to another user."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)  # so that the folder checked is the folder changed
    try:
        status = os.fstat(opened)
        if status.st_uid != os.geteuid():
            raise UsageError(
                f"{folder} belongs to the user with the id {status.st_uid}, who could read the seed and the truth in it; "
                "give another folder, or a folder of your own"
            )
        if status.st_mode & 0o077:
            os.fchmod(opened, _FOLDER_MODE)
    finally:
        os.close(opened)


def private_file(path: Path) -> Path:
    """Create an empty file that only this user can read, for a library that opens it by name; returns its path."""
    with world().disk.open(path, "wb"):
        return path


def private_pictures(path: Path) -> Path:
    """Create both files of a picture, `path`.png and `path`.pdf, in the same way; returns `path`."""
    for suffix in (".png", ".pdf"):
        private_file(path.with_suffix(suffix))
    return path


def write_private(path: Path, text: str) -> None:
    """Write a text to a file that only this user can read."""
    world().disk.write(path, text.encode())


def replace_private(path: Path, text: str) -> None:
    """Write a text to a file that only this user can read; at any moment the file is the old or the new one. Raises OSError."""
    with private_replacement(path) as unfinished:
        world().disk.write(unfinished, text.encode())


@contextlib.contextmanager
def private_replacement(path: Path, lasting: bool = True) -> Iterator[Path]:
    """The path of an empty file that only this user can read.

    The file replaces `path` when the block ends, and is removed if the block fails.

    lasting: whether a power cut after this leaves the whole file; otherwise it may leave nothing behind the name.

    Raises OSError.
    """
    unfinished = path.with_name(f"{path.name}.new")
    try:
        yield private_file(unfinished)
        if lasting:
            world().disk.sync(unfinished)
        world().disk.replace(unfinished, path)
    except BaseException:
        with suppress(OSError):
            world().disk.remove(unfinished)
        raise


@contextlib.contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Turn a full disk, or any other OSError when writing results, into a RunError."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{folder} cannot be written ({error.strerror or error}); free some space, or give another folder"
        ) from error


_F_GETPATH = 50  # of macOS; Python has no name for it before 3.9, and none on Linux


@final
class HeldFolder:
    """An open folder."""

    def __init__(self, path: Path) -> None:
        """Open the folder. Raises OSError if it cannot be opened."""
        self.first = path
        """Its path when it was opened."""
        self._descriptor = world().disk.hold(path)

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
        world().disk.let_go(self._descriptor)
