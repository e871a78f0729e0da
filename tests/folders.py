"""Temporary folders that root can remove without harm: never with anything mounted in them, never across file systems."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def mounted_below(folder: Path) -> list[Path]:
    """The mount points in a folder, the folder itself included, as this process sees them."""
    inside = folder.resolve()
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    points = [Path(_unescaped(line.split()[4])) for line in lines]
    return sorted(point for point in points if point.is_relative_to(inside))


def _unescaped(field: str) -> str:
    r"""A field of mountinfo, where a space is `\040`."""
    for octal, character in (("\\040", " "), ("\\011", "\t"), ("\\012", "\n"), ("\\134", "\\")):
        field = field.replace(octal, character)
    return field


def remove(folder: Path) -> None:
    """Remove a folder and all in it.

    Raises AssertionError, and removes nothing, if anything is mounted in it: a bind mount is on the same file system as
    the folder it shows, so only the table of mounts tells.
    """
    mounted = mounted_below(folder)
    assert not mounted, f"{folder} is not removed, for these are mounted in it: {', '.join(map(str, mounted))}"
    _empty(folder, folder.lstat().st_dev)
    folder.rmdir()


def _empty(folder: Path, device: int) -> None:
    """Remove all in a folder; what was mounted a moment ago is on another device, and ends it."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            assert entry.stat(follow_symlinks=False).st_dev == device, f"{entry.path} is on another file system"
            _empty(Path(entry.path), device)
            os.rmdir(entry.path)
        else:
            os.unlink(entry.path)


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A new folder that `remove` removes when the block ends."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    try:
        yield folder
    finally:
        remove(folder)
