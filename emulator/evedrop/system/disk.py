"""The disk of a world: every change that a program makes to a file or a folder goes through `world().disk`.

Programs read without it, since the files of a simulated disk are real ones, too; what the simulation decides is what a write
does, and what a kill or a power cut leaves behind.
"""

from __future__ import annotations

import mmap
import os
import shutil
from contextlib import suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from pathlib import Path
from typing import IO, Any, Protocol, final

_FILE_MODE = 0o600
_POPULATE = getattr(mmap, "MAP_POPULATE", 0)


def private_opener(path: str, flags: int) -> int:
    """An `opener` for `open`: new and existing files become readable by this user only."""
    opened = os.open(path, flags, _FILE_MODE)
    with suppress(PermissionError):  # a file system without modes
        os.fchmod(opened, _FILE_MODE)
    return opened


def write_all(file: FileIO, data: Any) -> None:
    """Write bytes to an open file. Raises OSError, such as for a full disk; some of them may have been written then."""
    left = memoryview(data)
    while left:  # a disk with little room accepts a part, and says so only when it is asked again
        left = left[file.write(left) :]


class Disk(Protocol):
    """What a program changes on a disk. All methods raise OSError if it refuses."""

    def open(self, path: Path, mode: str) -> FileIO:
        """Open a file without a buffer, which only this user can read; mode: as for `FileIO`."""

    def hold(self, folder: Path) -> int:
        """Open a folder; its descriptor, on which a lock lasts until `let_go` or the end of the process."""

    def let_go(self, descriptor: int) -> None:
        """Close a folder."""

    def again(self, file: IO[bytes]) -> IO[bytes]:
        """The same open file, without a buffer, to be closed on its own."""

    def sync(self, path: Path) -> None:
        """Return once a power cut would leave what was written to a file."""

    def map(self, file: FileIO, start: int, length: int, *, populate: bool = False) -> mmap.mmap:
        """The last bytes of an open file as memory, with zeros for those that the file does not have yet.

        start: where a mapping may begin; populate: whether to have all of them in memory at once.
        """

    def replace(self, old: Path, new: Path) -> None:
        """Give a file or folder another name; at any moment, a file that had this name is the old or the new one."""

    def remove(self, path: Path, missing_ok: bool = False) -> None:
        """Remove a file."""

    def make_folder(self, path: Path, mode: int, exist_ok: bool = False) -> None:
        """Make a folder whose parent exists."""

    def remove_tree(self, folder: Path, ignore_errors: bool = False) -> None:
        """Remove a folder and all that is in it."""

    def write(self, path: Path, data: bytes) -> None:
        """Write a file that only this user can read; replaces what it contained."""
        with self.open(path, "wb") as file:
            write_all(file, data)

    def writer(self, path: Path, mode: str = "wb") -> BufferedWriter:
        """Open a file in the same way, with a buffer."""
        return BufferedWriter(self.open(path, mode))

    def text_writer(self, path: Path, mode: str) -> TextIOWrapper:
        """Open a text in UTF-8 in the same way, with a buffer."""
        return TextIOWrapper(self.writer(path, mode), encoding="utf-8")


@final
class RealDisk(Disk):
    """The disks of the machine."""

    def open(self, path: Path, mode: str) -> FileIO:
        """Open a file."""
        return FileIO(path, mode, opener=private_opener)

    def hold(self, folder: Path) -> int:
        """Open a folder."""
        return os.open(folder, os.O_RDONLY | os.O_DIRECTORY)

    def let_go(self, descriptor: int) -> None:
        """Close a folder."""
        os.close(descriptor)

    def again(self, file: IO[bytes]) -> IO[bytes]:
        """The same open file."""
        return os.fdopen(os.dup(file.fileno()), "ab", buffering=0)

    def sync(self, path: Path) -> None:
        """Wait for the disk."""
        with path.open("rb", buffering=0) as file:
            os.fsync(file.fileno())

    def map(self, file: FileIO, start: int, length: int, *, populate: bool = False) -> mmap.mmap:
        """Reserve room on the disk, and map it."""
        if hasattr(os, "posix_fallocate"):  # not on macOS
            os.posix_fallocate(file.fileno(), start, length)
        elif (lacking := start + length - file.seek(0, os.SEEK_END)) > 0:
            write_all(file, bytes(lacking))
        flags = mmap.MAP_SHARED | (_POPULATE if populate else 0)
        return mmap.mmap(file.fileno(), length, flags=flags, offset=start)

    def replace(self, old: Path, new: Path) -> None:
        """Rename a file or folder."""
        os.replace(old, new)

    def remove(self, path: Path, missing_ok: bool = False) -> None:
        """Remove a file."""
        path.unlink(missing_ok)

    def make_folder(self, path: Path, mode: int, exist_ok: bool = False) -> None:
        """Make a folder."""
        path.mkdir(mode, exist_ok=exist_ok)

    def remove_tree(self, folder: Path, ignore_errors: bool = False) -> None:
        """Remove a folder and all that is in it."""
        shutil.rmtree(folder, ignore_errors)


REAL_DISK: Disk = RealDisk()
