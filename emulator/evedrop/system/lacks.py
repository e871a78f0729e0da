"""Recognises errors that say that the machine lacks something: memory, threads, processes or open files."""

from __future__ import annotations

import errno
import os
import resource
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import final

from evedrop.errors import RunError, UsageError
from evedrop.system.output import say
from evedrop.system.world import world

_SCIPY_BYTES, _THREAD_BYTES = 160_000_000, 45_000_000
"""The address space that scipy needs with one thread of OpenBLAS, and for each further one: measured were 86 and 41 MB."""
_MOST_THREADS = 64
_WITHOUT_ROOM = ("failed to map segment", "cannot allocate memory")
"""What the system says in an ImportError about a library that found no memory."""
_WITHOUT_REASON = ("without exception set", "without setting an exception")
"""What Python says in a SystemError if its own code, or an extension's, found no memory and raised no exception for it."""
_WITHOUT_THREAD = ("can't start new thread", "can't spawn worker thread", "Failed to launch worker thread")
"""What Python, Zenoh (in a PanicException, which does not derive from Exception) and Arrow say."""
_WITHOUT_FILE = "Failed to init "
"""What Zenoh says, in a PanicException, if it can open no file for its threads."""
_LACKS = {
    errno.EAGAIN: "no further process or thread can be started",
    errno.ENOMEM: "there is not enough memory",
    errno.EMFILE: "this process may open no further file",
    errno.ENFILE: "no further file can be opened",
}
_NO_FILE = (errno.EMFILE, errno.ENFILE)


def lack_of(error: BaseException) -> str | None:
    """What the machine lacks and what to do, as a message; None if the error says something else."""
    if (
        isinstance(error, MemoryError)
        or (isinstance(error, ImportError) and any(words in str(error).lower() for words in _WITHOUT_ROOM))
        or (isinstance(error, SystemError) and any(words in str(error) for words in _WITHOUT_REASON))
    ):
        lack = _LACKS[errno.ENOMEM]
    elif any(words in str(error) for words in _WITHOUT_THREAD):
        lack = _LACKS[errno.EAGAIN]
    elif _WITHOUT_FILE in str(error) and not isinstance(error, Exception):
        lack = _LACKS[errno.EMFILE]
    elif isinstance(error, OSError) and (error.filename is None or error.errno in _NO_FILE) and error.errno in _LACKS:
        lack = _LACKS[error.errno]
    else:
        return None
    return f"{lack}; free system resources, or raise the limit (ulimit -v, -u or -n, or the container's), and try again"


@final
class _ScipyFinder:
    """A finder that finds nothing: it only refuses scipy where the address space has no room for it."""

    @staticmethod
    def find_spec(name: str, _path: Sequence[str] | None = None, _target: ModuleType | None = None) -> None:
        """Called before each import. Raises MemoryError."""
        if name == "scipy" and not _has_room():
            raise MemoryError


def report_refusal(error: OSError) -> int:
    """Say what the system refused to a command, if it is not a lack; returns the command's exit status."""
    if error.filename is None:
        say(f"{error}; free system resources and try again")
        return RunError.exit_status
    say(f"{error.filename}: {error.strerror}; free some space, or check its permissions")
    return UsageError.exit_status


def refuse_scipy_without_room() -> None:
    """If the address space is limited (ulimit -v), let the import of scipy raise MemoryError where it has no room.

    OpenBLAS, which it loads, would ask for memory again and again, for ever, and no handler of a signal would run.
    """
    if _limit() is not None and not any(isinstance(finder, _ScipyFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _ScipyFinder())


def preload_within_limit() -> None:
    """If the address space is limited (ulimit -v), import now what a summary needs. Raises MemoryError if there is no room.

    Later there may be none, and a study would fail at its end.
    """
    if _limit() is None or "scipy.special" in sys.modules:
        return
    if not _has_room():
        raise MemoryError
    import_module("scipy.special")


def preload_meanwhile() -> None:
    """Import on a thread what a summary needs: a run that computes one while it is going on would stop for the import."""

    def load() -> None:
        with suppress(Exception):  # the summary's own import says what is wrong
            import_module("scipy.special")

    world().thread(load, name="preload").start()


def _limit() -> int | None:
    """The largest size of this process's address space, in bytes; None: unlimited."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


def _has_room() -> bool:
    """Whether the address space has room for scipy; True where the system does not say how large it is (outside Linux)."""
    limit = _limit()
    try:
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return True
    return limit is None or limit - used >= _SCIPY_BYTES + _THREAD_BYTES * (_threads() - 1)


def _threads() -> int:
    """The threads that OpenBLAS starts."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        if (text := os.environ.get(name, "")).isdecimal() and int(text):
            return min(int(text), processors, _MOST_THREADS)
    return min(processors, _MOST_THREADS)
