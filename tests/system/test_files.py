import errno
import os
from pathlib import Path

import pytest

from evedrop.errors import UsageError
from evedrop.system.files import whole_file, write_all


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


def test_a_line_of_which_only_a_part_fits_is_an_error(tmp_path: Path) -> None:
    """A pipe that nobody reads has only so much room, as a full disk has."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    try:
        write_all(writing, b"whole\n")
        assert os.read(reading, 100) == b"whole\n"
        with pytest.raises(OSError, match="No space left") as caught:
            write_all(writing, bytes(2**22), tmp_path)
    finally:
        os.close(reading)
        os.close(writing)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, tmp_path)


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
