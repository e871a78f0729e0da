"""What the simulated disk does that a real one does only on a bad day."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from evedrop.results.folder import replace_private
from evedrop.system.disk import write_all
from evedrop.system.world import world
from evedrop.virtual.disk import DiskFault
from evedrop.virtual.scheduler import VirtualTask
from tests.disks import VIRTUAL_SECONDS, at, run_program, simulated

PAGE = 4096


def write_twice(path: Path) -> None:
    """Operations 1 to 3."""
    with world().disk.open(path, "wb") as file:
        for data in (b"abcd", b"efgh"):
            write_all(file, data)


OUTCOMES = {
    DiskFault.SHORT: (b"abcdefgh", None),
    DiskFault.FULL_ONCE: (b"ab", "No space left"),
    DiskFault.FULL: (b"ab", "No space left"),
    DiskFault.BROKEN: (b"ab", "Input/output error"),
    DiskFault.KILL: (b"ab", None),
}


@pytest.mark.parametrize("fault", OUTCOMES)
def test_half_of_a_write_arrives(fault: DiskFault, tmp_path: Path) -> None:
    """And then the program is told what it would be told."""
    content, error = OUTCOMES[fault]
    with simulated(tmp_path, faults=at(2, fault)) as (scheduler, disk):
        path = disk.root / "file"
        if error is None:
            task = run_program(scheduler, lambda: write_twice(path))
            assert task.status == (-9 if fault is DiskFault.KILL else 0)
        else:
            with pytest.raises(OSError, match=error):
                run_program(scheduler, lambda: write_twice(path))
        assert path.read_bytes() == content


@pytest.mark.parametrize("fault", [DiskFault.FULL_ONCE, DiskFault.FULL])
def test_a_full_disk_stays_full_until_there_is_room(fault: DiskFault, tmp_path: Path) -> None:
    """Unless it is full only once."""
    with simulated(tmp_path, faults=at(2, fault)) as (scheduler, disk):

        def write(name: str) -> None:
            run_program(scheduler, lambda: write_twice(disk.root / name))

        for name in ("first", "second"):
            scheduler.errors.clear()
            if name == "first" or fault is DiskFault.FULL:
                with pytest.raises(OSError, match="No space left"):
                    write(name)
            else:
                write(name)
        disk.make_room()
        scheduler.errors.clear()
        write("third")
        assert (disk.root / "third").read_bytes() == b"abcdefgh"


def test_a_disk_that_is_full_for_some_time_has_room_again_though_nobody_has_written(tmp_path: Path) -> None:
    """Meanwhile; a fault that comes later is another one."""
    with simulated(tmp_path) as (scheduler, disk):

        def wait_and_write() -> None:
            world().sleep(3.0)
            write_twice(disk.root / "file")

        disk.fail_next(DiskFault.FULL, 2.0)
        run_program(scheduler, wait_and_write)
        assert (disk.root / "file").read_bytes() == b"abcdefgh"
        disk.fail_next(DiskFault.FULL, 2.0)
        disk.fail_next(DiskFault.BROKEN)
        with pytest.raises(OSError, match="Input/output error"):
            run_program(scheduler, wait_and_write)


@pytest.mark.parametrize("name", ["beside", "disk/../beside"])
def test_no_program_writes_outside_its_disk(name: str, tmp_path: Path) -> None:
    """The files of the machine are no part of the simulation."""
    with simulated(tmp_path) as (scheduler, disk):
        outside = disk.root.parent / name
        with pytest.raises(AssertionError, match="is not on the simulated disk"):
            run_program(scheduler, lambda: write_twice(outside))
        scheduler.errors.clear()
        assert not outside.exists()


def test_a_process_that_is_gone_changes_nothing_any_more(tmp_path: Path) -> None:
    """What it was to remove in the end stays."""
    with simulated(tmp_path, faults=at(4, DiskFault.KILL)) as (scheduler, disk):
        run_program(scheduler, lambda: replace_private(disk.root / "file", "text"))
        scheduler.take_down()
        assert {path.name: path.read_bytes() for path in disk.root.iterdir()} == {"file.new": b"text"}


def after_power_cuts(tmp_path: Path, work: Callable[[Path], object], seeds: int = 60) -> list[dict[str, bytes]]:
    """What power cuts leave that come when a program has done its work."""
    outcomes = []
    for seed in range(seeds):
        (tmp_path / str(seed)).mkdir()
        with simulated(tmp_path / str(seed), seed) as (scheduler, disk):

            def program(folder: Path = disk.root, cut: Callable[[], None] = disk.power_cut) -> None:
                work(folder)
                cut()

            assert run_program(scheduler, program).status == -9
            outcomes.append({path.name: path.read_bytes() for path in disk.root.iterdir()})
    return outcomes


def test_a_power_cut_takes_what_was_not_synced(tmp_path: Path) -> None:
    """All, nothing, or a part: bytes at the end, or pages that are zeros."""
    whole = b"x" * (20 * PAGE)

    def write(folder: Path) -> None:
        world().disk.write(folder / "file", whole)

    outcomes = after_power_cuts(tmp_path, write)
    assert {} in outcomes
    assert {"file": whole} in outcomes
    contents = {outcome["file"] for outcome in outcomes if outcome}
    assert b"" in contents
    assert any(0 < len(content) < len(whole) for content in contents)
    assert any(b"\0" in content and b"x" in content for content in contents)
    for content in contents:
        for first in range(0, len(content), PAGE):
            assert len({*content[first : first + PAGE]}) == 1


def test_a_power_cut_leaves_what_was_synced(tmp_path: Path) -> None:
    """And the names until then."""

    def write(folder: Path) -> None:
        world().disk.write(folder / "before", b"")
        with world().disk.open(folder / "file", "wb") as file:
            write_all(file, b"1" * PAGE)
            world().disk.sync(folder / "file")
            write_all(file, b"2")
        world().disk.write(folder / "after", b"")

    outcomes = after_power_cuts(tmp_path, write)
    for outcome in outcomes:
        assert {"before", "file"} <= {*outcome}
        assert outcome["file"].startswith(b"1" * PAGE)
    assert {"after" in outcome for outcome in outcomes} == {True, False}
    assert {outcome["file"][PAGE:] for outcome in outcomes} == {b"", b"\0", b"2"}


def test_a_page_that_was_written_again_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    """In a file, and in memory that is mapped from it."""

    def write(folder: Path) -> None:
        with world().disk.open(folder / "file", "w+b") as file:
            memory = world().disk.map(file, 0, 2 * PAGE)
            memory[:] = b"1" * 2 * PAGE
            world().disk.sync(folder / "file")
            memory[0:1] = b"2"
            file.seek(PAGE)
            file.write(b"3")

    pages = {(o["file"][:2], o["file"][PAGE : PAGE + 2]) for o in after_power_cuts(tmp_path, write)}
    assert pages == {(first, second) for first in (b"11", b"21") for second in (b"11", b"31")}


def test_names_are_lost_in_their_order(tmp_path: Path) -> None:
    """The newest first; a file that was removed or replaced is there again."""

    def change(folder: Path) -> None:
        disk = world().disk
        for name in ("old", "new", "other"):
            with disk.open(folder / name, "wb") as file:
                write_all(file, name.encode())
                disk.sync(folder / name)
        disk.replace(folder / "new", folder / "old")
        disk.remove(folder / "other")

    whole = {"old": b"old", "new": b"new", "other": b"other"}
    replaced = {"old": b"new", "other": b"other"}
    outcomes = after_power_cuts(tmp_path, change)
    assert all(outcome in (whole, replaced, {"old": b"new"}) for outcome in outcomes)
    assert all(outcome in outcomes for outcome in (whole, replaced, {"old": b"new"}))


def test_names_are_on_the_disk_after_five_seconds(tmp_path: Path) -> None:
    """Whatever was synced: what was in the files may not be."""

    def write(folder: Path) -> None:
        world().disk.make_folder(folder / "folder", 0o700)
        world().disk.make_folder(folder / "folder" / "inner", 0o700)
        world().disk.remove_tree(folder / "folder")
        world().disk.write(folder / "file", b"1")
        world().sleep(5.5)

    assert {outcome["file"] for outcome in after_power_cuts(tmp_path, write)} == {b"", b"\0", b"1"}


def test_a_seed_decides_everything(tmp_path: Path) -> None:
    """What a power cut leaves, and what is noted as an event."""

    def write(folder: Path) -> None:
        for name in "abc":
            replace_private(folder / name, name * 10_000)

    for name in "12":
        (tmp_path / name).mkdir()
    assert after_power_cuts(tmp_path / "1", write, 5) == after_power_cuts(tmp_path / "2", write, 5)


def test_the_end_of_the_world_closes_what_a_process_has_open(tmp_path: Path) -> None:
    """A process that is suspended for good closes nothing itself."""
    opened: list[int] = []
    with simulated(tmp_path) as (scheduler, disk):

        def suspended(task: VirtualTask) -> None:
            with disk.open(disk.root / "file", "wb") as file:
                opened.extend((disk.again(file).fileno(), disk.hold(disk.root)))
            scheduler.stop(task)
            scheduler.sleep(1.0)

        task = scheduler.process("program")
        scheduler.thread("main", lambda: suspended(task), task).start()
        scheduler.run(VIRTUAL_SECONDS, lambda: task.stopped)
        for descriptor in opened:
            os.fstat(descriptor)
    assert len(opened) == 2
    for descriptor in opened:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)
