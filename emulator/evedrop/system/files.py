"""Files that users name: read only if they are regular files, and only up to a limit; written completely or not at all.

A pipe or a device may never end, and some megabytes of a compressed file may expand to many gigabytes. Every reader here
stops as soon as it has read more than its limit, and reports the limit.
"""

from __future__ import annotations

import fcntl
import gzip
import io
import json
import os
import stat
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self, final

from evedrop.errors import UsageError
from evedrop.system.disk import write_all

LINE_CHARACTERS = 65_536
"""The longest line of a table."""


class Unreadable(ValueError):
    """A file that cannot be read, or is larger than its limit; the message is a phrase to put in brackets."""


@dataclass(frozen=True)
class Limit:
    """The most of a table to read, after decompression."""

    lines: int
    characters: int

    @classmethod
    def of_rows(cls, rows: int, columns: int = 1) -> Limit:
        """A limit with room for this many rows of numbers, for comments and empty lines, and for some other columns."""
        return cls(2 * rows + 10_000, 16 * 2**20 + max(1024, 32 * columns) * rows)


def check_writable(file: Path) -> None:
    """Raise OSError if a file cannot be written; it is left as it is. What is no file, such as a pipe, is not tried."""
    file = file.resolve()
    if file.exists() and not file.is_file() and not file.is_dir():
        return
    try:
        file.open("xb").close()
    except FileExistsError:
        file.open("ab").close()
    else:
        file.unlink()


def is_there(path: Path) -> bool:
    """Whether a path exists, even as a broken link; False for an impossible name."""
    try:
        return os.path.lexists(path)
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether a path is a folder; False for an impossible name."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def shown(path: object) -> str:
    """A path for a message or a table; bytes that are not UTF-8 are written in hexadecimal."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def opened(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises Unreadable if it does not exist, or is not a regular file."""
    try:
        # Opening a pipe without a writer would wait forever.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise Unreadable(why_of(error)) from error
    try:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            raise Unreadable("it is a folder" if stat.S_ISDIR(mode) else "it is a pipe or a device, not a file")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def contents(path: Path, most: int) -> bytes:
    """All bytes of a regular file. Raises Unreadable if it cannot be read, or has more than `most` bytes."""
    try:
        with opened(path) as file:
            # Asking for `most` bytes would reserve memory for all of them.
            size = os.fstat(file.fileno()).st_size
            content = file.read(min(size, most) + 1)
            if size < len(content) <= most:  # it has grown meanwhile
                content += file.read(most + 1 - len(content))
    except OSError as error:
        raise Unreadable(why_of(error)) from error
    if len(content) > most:
        raise Unreadable(f"it has more than {most} bytes")
    return content


def text_of(path: Path, most: int) -> str:
    """The text of a regular file in UTF-8, without a byte order mark. Raises Unreadable as `contents` does."""
    try:
        return contents(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Unreadable(f"it is not text in UTF-8: {error.reason} at byte {error.start}") from error


def lines_of(path: Path, limit: Limit) -> Iterator[str]:
    """The lines of a text file, decompressed if its name ends in .gz, with their line ends.

    Raises Unreadable once a line, or the whole text, exceeds the limit.
    """
    lines = characters = 0
    try:
        with opened(path) as raw, gzip.open(raw) if path.suffix == ".gz" else raw as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
            while line := text.readline(LINE_CHARACTERS + 1):
                lines += 1
                characters += len(line)
                if len(line) > LINE_CHARACTERS:
                    raise Unreadable(f"line {lines} has more than {LINE_CHARACTERS} characters")
                if lines > limit.lines or characters > limit.characters:
                    most = f"{limit.lines} lines" if lines > limit.lines else f"{limit.characters} characters"
                    raise Unreadable(f"it has more than {most}, comments and empty lines included")
                yield line
    except UnicodeDecodeError as error:
        raise Unreadable(f"it is not text in UTF-8 after line {lines}: {error.reason}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise Unreadable(why_of(error)) from error


def why_of(error: Exception) -> str:
    """The reason of a file system error, in a few words."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return next(iter(str(error).splitlines()), type(error).__name__)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file next to a path; it replaces the path when the block ends, and is removed if the block raises an error.

    Raises UsageError if it cannot be written, including for an OSError of the block that names no other file.
    """
    real = Path(os.path.realpath(path))
    if is_there(real) and not real.is_file():
        raise UsageError(f"{path} is not a file; give the name of one, or a new name")
    try:
        # Not by mkstemp's mode: a file whose name the user chose is not private.
        descriptor, name = tempfile.mkstemp(suffix=real.suffix, prefix=f".{real.name[:100]}-", dir=real.parent)
        os.close(descriptor)
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another file") from error
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_mask())
        os.replace(temporary, real)
    except OSError as error:
        if error.filename not in {None, name}:
            raise
        raise UsageError(f"{path} cannot be written ({error.strerror or error}); give another file") from error
    finally:
        temporary.unlink(missing_ok=True)


@final
class LineFile:
    """A file of lines that grows, such as JSON values, one a line. A line counts only if it is complete.

    So `lines_in` reads everything that was appended, wherever the process was killed or the disk became full.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, which is new or continues after its last complete line. Only this user can read it. Raises OSError."""
        from evedrop.system.world import world  # noqa: PLC0415 - the pytest plugin loads this module, and little else

        self._file = world().disk.open(path, "a+b")
        try:
            descriptor = self._file.fileno()
            self._size = os.fstat(descriptor).st_size
            if self._size and os.pread(descriptor, 1, self._size - 1) != b"\n":
                self._size = os.pread(descriptor, self._size, 0).rfind(b"\n") + 1
                self._file.truncate(self._size)
        except BaseException:
            self.close()
            raise

    def append(self, value: Any) -> bytes:
        """Add a line; returns it. Raises OSError if the disk has no room for it, and leaves the file as it was."""
        line = json.dumps(value).encode() + b"\n"
        self.write(line)
        return line

    def write(self, lines: bytes) -> None:
        """Add complete lines. Raises OSError as `append` does."""
        try:
            write_all(self._file, lines)
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._size)
            raise
        self._size += len(lines)

    @property
    def size(self) -> int:
        """The bytes of its lines."""
        return self._size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def lines_in(path: Path, last: int | None = None) -> list[bytes]:
    """The complete lines of a file to which another process may be adding. Raises OSError if it cannot be read.

    last: read only so many bytes at its end, in which the first line may not be whole.
    """
    with path.open("rb") as file:
        if last is not None:
            file.seek(max(0, os.fstat(file.fileno()).st_size - last))
        return file.read().split(b"\n")[:-1]


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open folder until it is closed; False if another process has it locked. A file system without locks locks nothing.

    shared: whether others may lock it so, too.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def is_locked(folder: Path) -> bool:
    """Whether a process has locked a folder; False for one that cannot be opened, and on a file system without locks."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        return not try_lock(descriptor, shared=True)  # shared: two readers at once do not see each other
    finally:
        os.close(descriptor)


def _mask() -> int:
    """The process's umask, which can only be read by changing it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
