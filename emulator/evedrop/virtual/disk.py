"""The simulated disk: real files in a folder of their own, and what a full disk, a kill or a power cut makes of them.

What a program has written by calls of the system, or into memory that is mapped from a file, survives its end; what
it still holds in a buffer of its own does not. A power cut may also take what was written to a file since it was synced, page by
page, and the changes of names of the last five seconds, the newest first.

Source: docs/maintainers/simulated-world.md, the simulated disk.
"""

from __future__ import annotations

import errno
import mmap
import os
import shutil
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from io import FileIO
from pathlib import Path
from typing import IO, Any, final

from evedrop.system.disk import Disk, RealDisk, private_opener
from evedrop.virtual import notes
from evedrop.virtual.scheduler import Ended, VirtualScheduler, VirtualTask

_PAGE = 4096
_COMMIT = 5.0
"""After so many seconds, ext4 has all names on the disk."""
_KILLED = -9


class DiskFault(Enum):
    """What goes wrong at an operation. If it is a write, half of the bytes arrive first."""

    SHORT = "short write"
    """The program is told how many bytes arrived."""
    FULL_ONCE = "full once"
    """The disk is full: the rest and the next write are refused, and later writes succeed."""
    FULL = "full"
    """The disk is full: the rest and all later writes are refused until `make_room`."""
    BROKEN = "input/output error"
    """The program is told that it failed."""
    KILL = "kill"
    """The process is killed."""
    POWER_CUT = "power cut"
    """All processes are killed, and the disk keeps what it has."""


DiskFaults = Callable[[int], DiskFault | None]
"""The number of an operation of the simulated programs, from 1 → what goes wrong at it."""


@dataclass
class _Unsynced:
    """What is on the disk of a file that has changed since."""

    size: int
    pages: dict[int, bytes] = field(default_factory=dict)
    """Number → a page below that size as it is on the disk."""
    maps: list[tuple[int, int]] = field(default_factory=list)
    """First byte and length of each part that is mapped into memory."""


@dataclass(frozen=True)
class _Change:
    """A change of names that is not on the disk yet."""

    at: float
    undo: Callable[[], object]
    kept: Path | None = None
    """Where the file that it removed is kept."""


@final
class VirtualDisk(Disk):
    """A disk for the programs of a simulated world. What others than they do to its files is on the disk at once."""

    def __init__(
        self, scheduler: VirtualScheduler, root: Path, faults: DiskFaults = lambda _: None, host: str = ""
    ) -> None:
        """root: an empty folder of this user, below which the programs write; faults: what goes wrong; host: whose disk it is."""
        self.root = root / "disk"
        """The folder below which the programs write."""
        self.faults = faults
        self.operations = 0
        """How many operations there were that could fail."""
        self.room: int | None = None
        """How many bytes there is room for; None: for any number."""
        self._refuses_once = False
        self._scheduler, self._host = scheduler, host
        self._kept = root / "removed"
        self._real = RealDisk()
        self._folders: dict[int, Callable[[], object]] = {}
        self._removed = 0
        self._unsynced: dict[int, _Unsynced] = {}
        self._changes: deque[_Change] = deque()
        for folder in (self.root, self._kept):
            folder.mkdir(0o700)

    # DiskFaults

    def fail_next(self, fault: DiskFault, seconds: float | None = None) -> None:
        """Let the next operation fail; seconds: until there is room again, if the disk is full."""
        at = self.operations + 1
        faults = self.faults = lambda operation: fault if operation == at else None

        def end() -> None:
            if self.faults is faults:  # a disk that nobody has used meanwhile was full in vain
                self.faults = lambda _: None
            self.make_room()

        self._scheduler.after_seconds(seconds, end)

    def make_room(self) -> None:
        """Let the disk be full no longer."""
        self.room, self._refuses_once = None, False

    def power_cut(self) -> None:
        """Kill all processes of its host, and leave what the disk has by chance. Never returns if a program calls it."""
        scheduler = self._scheduler
        scheduler.note("power cut")
        mine = None if scheduler.current is None else scheduler.current.task
        for task in scheduler.tasks:
            if task is not mine and task.host == self._host:
                scheduler.end(task, _KILLED)
        self._lose()
        if mine is not None:
            scheduler.end(mine, _KILLED)

    def _lose(self) -> None:
        """Undo the newest changes of names, and then let some pages of each file that was not synced be old ones."""
        random = self._scheduler.random
        share = random.choice((0.0, 0.03, 0.3, 1.0))
        """Of the files, and of the pages of the others, that were not written back."""
        self._commit(self._scheduler.now - _COMMIT)
        lost = random.choice((0, random.randint(0, len(self._changes)), len(self._changes)))
        for _ in range(lost):
            with suppress(OSError):  # somebody else moved the folder
                self._changes.pop().undo()
        self._commit()
        for path in sorted(path for path in self.root.rglob("*") if path.is_file()):
            unsynced = self._unsynced.get(path.stat().st_ino)
            if unsynced is not None and random.random() < max(share, 0.1):
                left = self._left(path.read_bytes(), unsynced, share)
                other = self._kept / "left"  # a new file: the old one may be mapped into the memory of the dead
                other.write_bytes(left)
                os.replace(other, path)
        self._unsynced.clear()

    def _left(self, content: bytes, on_disk: _Unsynced, share: float) -> bytes:
        """What a power cut leaves of a file with this content."""
        random = self._scheduler.random
        before = min(on_disk.size, len(content))
        size = random.choice((before, random.randint(before, len(content)), len(content), len(content)))
        left = bytearray(content[:size])
        for number, page in on_disk.pages.items():
            at = number * _PAGE
            if at < size and random.random() < share:
                left[at : min(size, at + _PAGE)] = page.ljust(_PAGE, b"\0")[: size - at]
        for at in range(
            before - before % _PAGE, size, _PAGE
        ):  # new pages have a place on the disk before they have contents
            if random.random() < share:
                first, last = max(at, before), min(size, at + _PAGE)
                left[first:last] = bytes(last - first)
        return bytes(left)

    def _commit(self, until: float | None = None) -> None:
        """The names that were changed until then are on the disk; None: all."""
        while self._changes and (until is None or self._changes[0].at <= until):
            kept = self._changes.popleft().kept
            if kept is not None:
                self._unsynced.pop(kept.stat().st_ino, None)
                kept.unlink()

    def _changed(self, undo: Callable[[], object], kept: Path | None = None) -> None:
        self._commit(self._scheduler.now - _COMMIT)
        self._changes.append(_Change(self._scheduler.now, undo, kept))

    def _keep(self) -> Path:
        """A place for a file that is removed."""
        self._removed += 1
        return self._kept / str(self._removed)

    # What a file asks

    def caller(self) -> VirtualTask | None:
        """The process that asks; None for the world itself. A process that is gone does nothing any more."""
        current = self._scheduler.current
        if current is None:
            return None
        if not current.task.alive:
            raise Ended
        return current.task

    def begin(self, what: str, path: Path, *words: object) -> DiskFault | None:
        """An operation begins; returns what goes wrong at it. Raises AssertionError outside the folder of the disk."""
        if (caller := self.caller()) is None:
            return None
        if not os.path.abspath(path).startswith(f"{self.root}/"):
            raise AssertionError(f"{caller.name} {what} {path}, which is not on the simulated disk")
        caller.allocate()
        self.operations += 1
        self._scheduler.note(notes.WRITES, caller.name, what, str(path).removeprefix(f"{self.root}/"), *words)
        return self.faults(self.operations)

    def fail(self, fault: DiskFault | None, path: Path) -> None:
        """Let something go wrong, once what arrives has arrived."""
        if fault is DiskFault.KILL:
            assert self._scheduler.current is not None  # noqa: S101 - only programs meet faults
            self._scheduler.end(self._scheduler.current.task, _KILLED)
        elif fault is DiskFault.POWER_CUT:
            self.power_cut()
        elif fault is DiskFault.BROKEN:
            raise _error(errno.EIO, path)
        elif fault in {DiskFault.FULL, DiskFault.FULL_ONCE}:
            self.room, self._refuses_once = 0, fault is DiskFault.FULL_ONCE

    def grown(self, wanted: int) -> int:
        """How many of some bytes there is room for; they are used now."""
        if self.room is None:
            return wanted
        fits = min(wanted, self.room)
        self.room -= fits
        return fits

    def refuse(self, path: Path) -> None:
        """Raise the error of a full disk."""
        if self._refuses_once:
            self.make_room()
        raise _error(errno.ENOSPC, path)

    def step(self, what: str, path: Path) -> None:
        """An operation that happens wholly or not at all, before which another thread may go on."""
        self._scheduler.interruptible()
        self.fail(self.begin(what, path), path)

    def unsynced(self, file: FileIO) -> _Unsynced:
        """What is on the disk of an open file, which is about to change."""
        status = os.fstat(file.fileno())
        unsynced = self._unsynced.get(status.st_ino)
        if unsynced is None:
            unsynced = self._unsynced[status.st_ino] = _Unsynced(status.st_size)
        return unsynced

    def keep_pages(self, file: FileIO, first: int, last: int) -> None:
        """Keep the pages between two places of an open file as they are on the disk."""
        unsynced = self.unsynced(file)
        for number in range(first // _PAGE, -(-min(last, unsynced.size) // _PAGE)):
            if number not in unsynced.pages:
                unsynced.pages[number] = os.pread(file.fileno(), _PAGE, number * _PAGE)

    # What programs ask

    def open(self, path: Path, mode: str) -> FileIO:
        """Open a file."""
        if "w" in mode or not path.exists():
            self.step("opens", path)
        new = not path.exists()
        file = _VirtualFile(self, path, mode, self.caller())
        if new or "w" in mode:
            self._unsynced[os.fstat(file.fileno()).st_ino] = _Unsynced(0)
        if new:
            self._changed(lambda: path.unlink(missing_ok=True))
        return file

    def hold(self, folder: Path) -> int:
        """Open a folder."""
        task = self.caller()
        descriptor = self._real.hold(folder)
        if task is not None:
            release = self._folders[descriptor] = partial(os.close, descriptor)
            task.files.append(release)
        return descriptor

    def let_go(self, descriptor: int) -> None:
        """Close a folder."""
        task = self.caller()
        if task is not None:
            task.files.remove(self._folders.pop(descriptor))
        os.close(descriptor)

    def again(self, file: IO[bytes]) -> IO[bytes]:
        """The same open file, which the end of the process closes."""
        again = self._real.again(file)
        task = self.caller()
        if task is not None:
            task.files.append(again.close)
        return again

    def sync(self, path: Path) -> None:
        """Have the whole file on the disk, and all names."""
        self.step("syncs", path)
        with FileIO(path) as file:
            maps = self.unsynced(file).maps
            status = os.fstat(file.fileno())
            self._unsynced[status.st_ino] = _Unsynced(status.st_size, maps=maps)
            for start, length in maps:
                self.keep_pages(file, start, start + length)
        self._commit()

    def map(self, file: FileIO, start: int, length: int, *, populate: bool = False) -> mmap.mmap:
        """Map a file: what is written into the memory survives a kill, but may not survive a power cut."""
        path = Path(str(file.name))
        self.step("maps", path)
        lacks = max(0, start + length - os.fstat(file.fileno()).st_size)
        if self.grown(lacks) < lacks:
            self.refuse(path)
        self.keep_pages(file, start, start + length)
        self.unsynced(file).maps.append((start, length))
        return self._real.map(file, start, length, populate=populate)

    def replace(self, old: Path, new: Path) -> None:
        """Rename a file or folder."""
        self.step("renames", new)
        kept = self._keep() if new.is_file() else None
        if kept is not None:
            os.link(new, kept)

        def undo() -> None:
            os.replace(new, old)
            if kept is not None:
                os.replace(kept, new)

        os.replace(old, new)
        self._changed(undo, kept)

    def remove(self, path: Path, missing_ok: bool = False) -> None:
        """Remove a file."""
        self.step("removes", path)
        kept = self._keep()
        try:
            os.replace(path, kept)
        except FileNotFoundError:
            if not missing_ok:
                raise
        else:
            self._changed(lambda: os.replace(kept, path), kept)

    def make_folder(self, path: Path, mode: int, exist_ok: bool = False) -> None:
        """Make a folder."""
        self.step("makes", path)
        new = not path.exists()
        path.mkdir(mode, exist_ok=exist_ok)
        if new:
            self._changed(lambda: shutil.rmtree(path))

    def remove_tree(self, folder: Path, ignore_errors: bool = False) -> None:
        """Remove a folder and all that is in it, in any order."""
        errors: AbstractContextManager[None] = suppress(OSError) if ignore_errors else nullcontext()
        with errors:
            names = sorted(os.listdir(folder))
            self._scheduler.random.shuffle(names)
            for path in (folder / name for name in names):
                if path.is_dir() and not path.is_symlink():
                    self.remove_tree(path, ignore_errors)
                else:
                    with errors:
                        self.remove(path)
            self.step("removes", folder)
            mode = folder.stat().st_mode
            folder.rmdir()
            self._changed(lambda: folder.mkdir(mode))


@final
class _VirtualFile(FileIO):
    """An open file of a simulated process, whose end closes it."""

    def __init__(self, disk: VirtualDisk, path: Path, mode: str, task: VirtualTask | None) -> None:
        # Readable in any case, for the pages that a power cut may leave.
        super().__init__(path, mode if "+" in mode else f"{mode}+", opener=private_opener)
        self._disk, self._path, self._task = disk, path, task
        self._appends = "a" in mode
        self._release = super().close
        if task is not None:
            task.files.append(self._release)

    def write(self, data: Any) -> int:
        """Write what arrives."""
        data = memoryview(data).cast("B")
        fault = self._disk.begin("writes", self._path)
        size = os.fstat(self.fileno()).st_size
        at = size if self._appends else self.tell()
        grows = max(0, at + len(data) - size)
        if fault is not None:
            grows -= grows // 2
        arrives = min(len(data), max(0, size - at)) + self._disk.grown(grows)
        self._disk.keep_pages(self, at, at + arrives)
        if arrives:
            super().write(data[:arrives])
        self._disk.fail(fault, self._path)
        if len(data) and not arrives:
            self._disk.refuse(self._path)
        return arrives

    def truncate(self, size: int | None = None) -> int:
        """Change the size, which is on the disk at once."""
        self._disk.step("truncates", self._path)
        size = self.tell() if size is None else size
        unsynced = self._disk.unsynced(self)
        unsynced.size = min(unsynced.size, size)
        return super().truncate(size)

    def close(self) -> None:
        """Close it."""
        if not self.closed and self._task is not None:
            with suppress(ValueError):  # it could not be opened, or its process is gone
                self._task.files.remove(self._release)
        super().close()


def _error(number: int, path: Path) -> OSError:
    return OSError(number, os.strerror(number), str(path))
