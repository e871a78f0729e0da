"""The processes of a run as the system shows them."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def words_of(pid: int | str) -> list[str]:
    """The command line of a process, without the spaces and zero bytes between its words. Raises OSError if it has ended."""
    return re.split(r"[\0 ]+", Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").strip("\0 "))


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal in place."""
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
        return bool(caught >> (number - 1) & 1)
    return False


def parent_of(pid: int) -> int:
    """The id of a process's parent. Raises OSError if it has ended."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def descendants(pid: int) -> Iterator[int]:
    """The ids of all processes that descend from one, whichever of its threads started them."""
    children = list[str]()
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # it has ended
            children += (thread / "children").read_text().split()
    for child in children:
        yield int(child)
        yield from descendants(int(child))
