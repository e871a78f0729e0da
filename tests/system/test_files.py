import errno
import os
from pathlib import Path

import pytest

from evedrop.errors import UsageError
from evedrop.system.files import LineFile, check_writable, lines_in, whole_file
from tests.disks import simulated


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    """Until then the old file is there; a link stays a link, and the file's mode follows the umask."""
    path, link = tmp_path / "f.png", tmp_path / "link.png"
    path.write_text("old")
    link.symlink_to(path)
    mask = os.umask(0o027)
    try:
        with whole_file(link) as temporary:
            temporary.write_text("new")
            assert path.read_text() == "old"
            assert temporary.suffix == ".png"
    finally:
        os.umask(mask)
    assert path.read_text() == "new"
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    assert sorted(tmp_path.iterdir()) == [path, link]


@pytest.mark.parametrize("room", range(9))
def test_a_line_for_which_the_disk_has_no_room_does_not_count(room: int, tmp_path: Path) -> None:
    """Whatever part of it fits: the file stays as it was, and goes on when there is room again."""
    with simulated(tmp_path) as (_, disk):
        path = disk.root / "lines"
        with LineFile(path) as file:
            file.append(["first"])
            disk.room = room
            with pytest.raises(OSError, match="No space left"):
                file.append(["second"])
            disk.make_room()
            assert lines_in(path) == [b'["first"]']
            file.append(["third"])
        assert lines_in(path) == [b'["first"]', b'["third"]']


@pytest.mark.parametrize("torn", ["", "[", '["second"'])
def test_a_file_of_lines_goes_on_after_a_kill(torn: str, tmp_path: Path) -> None:
    """A line that was being written is not read, and does not become the beginning of the next."""
    path = tmp_path / "lines"
    path.write_text(f'["first"]\n{torn}')
    assert lines_in(path) == [b'["first"]']
    with LineFile(path) as file:
        file.append({"third": 3})
    assert path.read_text() == '["first"]\n{"third": 3}\n'
    assert lines_in(path, last=13) == [b'{"third": 3}']


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no")])
def test_an_error_leaves_the_old_file_and_no_other(error: BaseException, tmp_path: Path) -> None:
    """So does Ctrl-C."""
    path = tmp_path / "f.png"
    path.write_text("old")
    with pytest.raises(type(error)), whole_file(path) as temporary:  # noqa: PT012 - the error is the block's
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_a_mistake_with_the_file_named(tmp_path: Path) -> None:
    """Nothing is left of it."""
    with (
        pytest.raises(UsageError, match=r"f\.mp4 cannot be written \(No space left") as told,
        whole_file(tmp_path / "f.mp4"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(tmp_path) in str(told.value)
    assert list(tmp_path.iterdir()) == []


def test_an_error_about_another_file_is_passed_on(tmp_path: Path) -> None:
    """An error that names another file is not changed, because its remedy differs."""
    with pytest.raises(FileNotFoundError, match="elsewhere"), whole_file(tmp_path / "f.mp4"):
        raise FileNotFoundError(errno.ENOENT, "none", "/elsewhere")


@pytest.mark.parametrize("name", ["", "pipe", "missing/f.png"])
def test_what_is_not_a_file_is_refused(name: str, tmp_path: Path) -> None:
    """A folder, a pipe or a device is not replaced."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="give"), whole_file(tmp_path / name):
        pytest.fail("it was opened")
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_file_that_can_be_written_is_left_as_it_is(tmp_path: Path) -> None:
    """So is a link to one that does not exist yet."""
    link, file, known = (tmp_path / name for name in ("link", "file", "known"))
    link.symlink_to(file)
    known.write_text("text")
    for path in (link, file, known):
        check_writable(path)
    assert (link.is_symlink(), file.exists(), known.read_text()) == (True, False, "text")
    with pytest.raises(OSError, match="No such file"):
        check_writable(tmp_path / "nowhere" / "file")
