"""The processes of a run as the system knows them: all descendants of the campaign, whatever their parents are now.

A look at /proc takes time, and a process whose parent dies meanwhile is listed below a parent that is no longer there. So a
look is repeated until two in a row agree; a process is also known by the folder for temporary files that it was given; and the
campaign, which adopts orphans, asks the system whether it has any child, which the system answers at one instant.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from evedrop.system.signals import SHOW_STACKS
from tests.processes import words_of

_STACKS_SECONDS = 1.0
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER
_NEW_MOUNTS = 0x00020000  # CLONE_NEWNS


def adopt_orphans() -> None:
    """From now on a process whose parent dies becomes our child, so that none gets out of sight."""
    if ctypes.CDLL(None, use_errno=True).prctl(_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")


def mounts_of_our_own() -> bool:
    """Enter a mount namespace of our own, which ends with us; whether we may. No other thread may run yet."""
    if os.geteuid() or ctypes.CDLL(None, use_errno=True).unshare(_NEW_MOUNTS):
        return False
    return subprocess.run(["mount", "--make-rprivate", "/"], check=False, capture_output=True).returncode == 0


def heed_signals() -> None:
    """Let the runs heed signals that we were started to ignore: a job in the background, or under nohup."""
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # which a process that is started does not inherit


@dataclass(frozen=True)
class Process:
    """A living process of the run."""

    pid: int
    words: tuple[str, ...]
    """Its command line."""

    @property
    def brief(self) -> Path | None:
        """The brief it was started with, if it is a process of the network."""
        last = self.words[-1] if self.words else ""
        return Path(last) if last.endswith(".json") and "/evedrop-" in last else None

    @property
    def is_fork_server(self) -> bool:
        """Whether it is a fork server of the run."""
        return "evedrop.fork_server" in self.words

    @property
    def is_cleaner(self) -> bool:
        """Whether it is the shell that removes the private folder when the launcher is dead."""
        return (
            len(self.words) > 1
            and Path(self.words[0]).name == "sh"
            and Path(self.words[-1]).name.startswith("evedrop-")
        )


def descendants() -> list[Process]:
    """All living processes that descend from us."""
    seen = _look()
    while (again := _look()) != seen:
        seen = again
    return [Process(pid, tuple(words)) for pid in sorted(seen) if (words := _words(pid)) is not None]


def _words(pid: int) -> list[str] | None:
    try:
        return words_of(pid)
    except OSError:
        return None


def _look() -> frozenset[int]:
    """The descendants by one look at all processes."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, parent = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
            if state not in "ZX":
                children.setdefault(int(parent), []).append(int(folder.name))
    pids, waiting = set[int](), list(children.get(os.getpid(), []))
    while waiting:
        pid = waiting.pop()
        pids.add(pid)
        waiting += children.get(pid, [])
    return frozenset(pids)


def marked(*temporaries: Path) -> Iterator[Process]:
    """All living processes whose TMPDIR is one of these folders, including those that have a new parent."""
    marks = {f"TMPDIR={temporary}".encode() for temporary in temporaries}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if marks & {*(folder / "environ").read_bytes().split(b"\0")} and folder.name != str(os.getpid()):
                state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in "ZX":
                    yield Process(int(folder.name), tuple(words_of(folder.name)))


def none_left(before: frozenset[int], seconds: float, *temporaries: Path) -> list[Process]:
    """Wait until no descendants are left except the earlier ones; returns those that remain after this number of seconds.

    temporaries: the run's folders for temporary files, by which its processes are known as well.
    """
    deadline = time.monotonic() + seconds
    while True:
        left = {process.pid: process for process in descendants() if process.pid not in before}
        left |= {process.pid: process for process in marked(*temporaries) if process.pid not in before}
        if not left and (before or not _has_children()):
            return []
        if left and time.monotonic() > deadline:
            return list(left.values())
        time.sleep(0.05 if left else 0.001)  # a child that no look found moves fast


def _has_children() -> bool:
    """Whether we have a child that lives; collects those that have ended. Only for a process that has no other children."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
        return True
    return False


def doing(pid: int) -> str:
    """Why a process did not end: what each thread waits for, and what else holds its standard input."""
    try:
        stdin = os.readlink(f"/proc/{pid}/fd/0")
        waits = [
            f"{(task / 'stat').read_text().rpartition(')')[2].split()[0]} {(task / 'wchan').read_text()}"
            for task in sorted(Path(f"/proc/{pid}/task").iterdir())
        ]
    except OSError as error:
        return f"it ended meanwhile ({error})"
    holders = []
    for fd in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):
            if os.readlink(fd) == stdin and fd.parts[2] != str(pid):
                holders.append(fd.parts[2])
    return (
        f"threads: {', '.join(waits)}; standard input {stdin}, also held by {', '.join(sorted(set(holders))) or 'nobody'}; "
        f"stacks: {_stacks(pid)}"
    )


def _stacks(pid: int) -> str:
    """What each thread of a process does, as the process itself writes it to its log on request."""
    try:
        log = open(f"/proc/{pid}/fd/2", errors="replace")  # noqa: SIM115 - closed below, opening alone may fail
    except OSError as error:
        return f"no log ({error})"
    with log:
        log.seek(0, os.SEEK_END)
        with suppress(OSError):
            os.kill(pid, SHOW_STACKS)
        time.sleep(_STACKS_SECONDS)
        return log.read()


def end_all(processes: list[Process]) -> None:
    """End what a failed case has left."""
    for process in processes:
        with suppress(OSError):
            os.kill(process.pid, signal.SIGKILL)
    for process in processes:
        with suppress(OSError):
            os.waitpid(process.pid, 0)


def reap() -> None:
    """Collect orphans that have ended."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
