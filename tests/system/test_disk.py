"""What programs rely on at a disk, held by the machine's and by the simulated one."""

from __future__ import annotations

import os
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import final

import pytest

from evedrop.system.disk import REAL_DISK, Disk, write_all
from evedrop.system.files import LineFile, is_locked, lines_in, try_lock
from evedrop.system.world import world
from evedrop.virtual.disk import VirtualDisk
from evedrop.virtual.scheduler import VirtualScheduler
from tests.disks import run_program, simulated

GRAIN = 4096


class Machine(ABC):
    """A disk, and programs that use it."""

    disk: Disk
    folder: Path

    @abstractmethod
    def kill_after(self, program: str) -> None:
        """Let a program of this module run, and kill it as soon as it has done its work."""

    @abstractmethod
    def with_room(self, room: int, program: str) -> None:
        """Let a program of this module run while no file can have more bytes than `room`."""


@final
class RealMachine(Machine):
    """The one that runs the tests."""

    def __init__(self, folder: Path) -> None:
        self.disk, self.folder = REAL_DISK, folder

    def kill_after(self, program: str) -> None:
        """Kill a process of the system."""
        assert self._status(program, "os.kill(os.getpid(), signal.SIGKILL)") == -9

    def with_room(self, room: int, program: str) -> None:
        """Limit the files of a process of the system."""
        limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))"
        assert self._status(program, "pass", limit) == 0

    def _status(self, program: str, then: str, first: str = "pass") -> int:
        code = (
            f"import os, resource, signal\nfrom pathlib import Path\nfrom tests.system.test_disk import {program}\n"
            f"{first}\nkept = {program}(Path({str(self.folder)!r}))\n{then}\n"
        )
        return subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[2]).returncode


@final
class SimulatedMachine(Machine):
    """A simulated one."""

    def __init__(self, scheduler: VirtualScheduler, disk: VirtualDisk) -> None:
        self.disk, self.folder = disk, disk.root
        self._scheduler, self._virtual = scheduler, disk

    def kill_after(self, program: str) -> None:
        """Kill a simulated process."""

        def work() -> None:
            kept = globals()[program](self.folder)
            self._scheduler.end(task, -9)
            raise AssertionError(kept)

        task = self._scheduler.process("program")
        self._scheduler.thread("main", work, task).start()
        self._scheduler.run(1.0, lambda: not task.alive)
        assert task.status == -9

    def with_room(self, room: int, program: str) -> None:
        """Let the disk have little room."""
        self._virtual.room = room
        run_program(self._scheduler, lambda: globals()[program](self.folder))
        self._virtual.make_room()


@pytest.fixture(params=["real", "simulated"])
def machine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Machine]:
    """Both of them, one after the other."""
    if request.param == "real":
        yield RealMachine(tmp_path)
        return
    with simulated(tmp_path) as (scheduler, disk):
        yield SimulatedMachine(scheduler, disk)


def test_a_file_that_is_opened_again_goes_on_at_its_end(machine: Machine) -> None:
    """Opening it for writing removes what it contained."""
    path = machine.folder / "file"
    for text in (b"one ", b"two"):
        with machine.disk.open(path, "ab") as file:
            write_all(file, text)
    assert path.read_bytes() == b"one two"
    machine.disk.write(path, b"3")
    assert path.read_bytes() == b"3"
    with machine.disk.text_writer(path, "ab") as text_file:
        text_file.write("ö")
    assert path.read_text("utf-8") == "3ö"
    with pytest.raises(FileExistsError):
        machine.disk.open(path, "xb")


def test_only_this_user_can_read_what_is_written(machine: Machine) -> None:
    """A file that was there before, too."""
    path = machine.folder / "file"
    path.write_bytes(b"old")
    path.chmod(0o666)
    before = os.umask(0)
    try:
        machine.disk.write(path, b"new")
        machine.disk.write(machine.folder / "other", b"new")
    finally:
        os.umask(before)
    assert {file.stat().st_mode & 0o777 for file in machine.folder.iterdir()} == {0o600}


def test_a_replaced_file_is_the_new_one(machine: Machine) -> None:
    """A reader that has the old file open can still read it to its end."""
    old, new = machine.folder / "file", machine.folder / "file.new"
    machine.disk.write(old, b"old")
    machine.disk.write(new, b"new")
    with old.open("rb") as reader:
        machine.disk.replace(new, old)
        assert (old.read_bytes(), reader.read()) == (b"new", b"old")
    assert [path.name for path in machine.folder.iterdir()] == ["file"]
    with pytest.raises(FileNotFoundError):
        machine.disk.replace(new, old)


def test_files_and_folders_are_made_and_removed(machine: Machine) -> None:
    """With the errors of the system, unless they are no errors to the caller."""
    folder = machine.folder / "folder"
    machine.disk.make_folder(folder, 0o700)
    machine.disk.make_folder(folder, 0o700, exist_ok=True)
    with pytest.raises(FileExistsError):
        machine.disk.make_folder(folder, 0o700)
    machine.disk.write(folder / "file", b"1")
    machine.disk.make_folder(folder / "inner", 0o700)
    machine.disk.write(folder / "inner" / "file", b"1")
    machine.disk.remove(folder / "file")
    machine.disk.remove(folder / "file", missing_ok=True)
    with pytest.raises(FileNotFoundError):
        machine.disk.remove(folder / "file")
    machine.disk.remove_tree(folder)
    machine.disk.remove_tree(folder, ignore_errors=True)
    with pytest.raises(FileNotFoundError):
        machine.disk.remove_tree(folder)
    assert not folder.exists()


def test_a_lock_excludes_others_until_its_folder_is_closed(machine: Machine) -> None:
    """Readers see it."""
    holder, other = machine.disk.hold(machine.folder), machine.disk.hold(machine.folder)
    assert try_lock(holder)
    assert not try_lock(other)
    assert is_locked(machine.folder)
    machine.disk.let_go(holder)
    assert not is_locked(machine.folder)
    assert try_lock(other)
    machine.disk.let_go(other)


def locks(folder: Path) -> int:
    """Lock the folder."""
    descriptor = world().disk.hold(folder)
    assert try_lock(descriptor)
    return descriptor


def test_the_end_of_a_process_releases_its_locks(machine: Machine) -> None:
    """By whatever it is ended."""
    machine.kill_after("locks")
    assert not is_locked(machine.folder)


def writes(folder: Path) -> object:
    """Write in all ways."""
    disk = world().disk
    buffered = disk.writer(folder / "buffered")
    buffered.write(b"flushed")
    buffered.flush()
    buffered.write(b"not flushed")
    with disk.open(folder / "mapped", "w+b") as file:
        memory = disk.map(file, 0, GRAIN)
    memory[:6] = b"mapped"
    plain = disk.open(folder / "plain", "wb")
    plain.write(b"written")
    return buffered, memory, plain


def test_a_kill_takes_only_what_is_in_a_buffer_of_the_program(machine: Machine) -> None:
    """What the system has, and what was written into mapped memory, stays."""
    machine.kill_after("writes")
    contents = {path.name: path.read_bytes() for path in machine.folder.iterdir()}
    assert contents == {"buffered": b"flushed", "mapped": b"mapped".ljust(GRAIN, b"\0"), "plain": b"written"}


def appends(folder: Path) -> None:
    """Append a line that fits, and one that does not."""
    with LineFile(folder / "lines") as file:
        file.append("fits")
        with pytest.raises(OSError, match=r"No space left|File too large"):
            file.append("x" * 100)
        assert lines_in(folder / "lines") == [b'"fits"']


def test_a_full_disk_takes_a_part_of_a_line_and_then_refuses(machine: Machine) -> None:
    """The line does not count."""
    machine.with_room(50, "appends")
    assert (machine.folder / "lines").read_bytes() == b'"fits"\n'


def fills(folder: Path) -> None:
    """Write more than there is room for."""
    with world().disk.open(folder / "file", "wb") as file, pytest.raises(OSError, match=r"No space|too large"):
        write_all(file, bytes(100))


def test_what_fits_is_written(machine: Machine) -> None:
    """As by a write of the system, which says how much of it that is."""
    machine.with_room(50, "fills")
    assert (machine.folder / "file").read_bytes() == bytes(50)


def maps_too_much(folder: Path) -> None:
    """Map more than there is room for."""
    with world().disk.open(folder / "file", "w+b") as file, pytest.raises(OSError, match=r"No space|too large"):
        world().disk.map(file, 0, 2 * GRAIN)


def test_memory_is_mapped_only_if_there_is_room_for_it(machine: Machine) -> None:
    """Or a program that writes into it would be ended by a signal."""
    machine.with_room(GRAIN, "maps_too_much")


def test_a_device_that_is_full_is_an_error() -> None:
    """However little is to be written."""
    with FileIO("/dev/full", "w") as full, pytest.raises(OSError, match="No space left"):
        write_all(full, b"1")


def test_a_file_that_was_synced_can_be_synced_again(machine: Machine) -> None:
    """With what was written and mapped meanwhile."""
    with machine.disk.open(machine.folder / "file", "w+b") as file:
        memory = machine.disk.map(file, 0, GRAIN)
        for byte in (b"1", b"2"):
            memory[:1] = byte
            machine.disk.sync(machine.folder / "file")
    assert (machine.folder / "file").read_bytes()[:1] == b"2"
    memory.close()
