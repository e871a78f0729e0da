"""Recognises errors that say that the machine lacks something: memory, threads, processes or open files."""

from __future__ import annotations

import errno
import os
import resource
from importlib import import_module
from pathlib import Path

_SPECIAL_BYTES = 200_000_000
"""The address space that the import of scipy.special needs: 114 MB were measured, with two processors."""
_WITHOUT_ROOM = ("failed to map segment", "cannot allocate memory")
"""What the system says in an ImportError about a library that found no memory."""
_LACKS = {
    errno.EAGAIN: "no further process or thread can be started",
    errno.ENOMEM: "there is not enough memory",
}


def lack_of(error: BaseException) -> str | None:
    """What the machine lacks and what to do, as a message; None if the error says something else."""
    if isinstance(error, MemoryError) or (
        isinstance(error, ImportError) and any(words in str(error).lower() for words in _WITHOUT_ROOM)
    ):
        lack = _LACKS[errno.ENOMEM]
    elif isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        lack = _LACKS[errno.EAGAIN]
    elif isinstance(error, OSError) and error.filename is None and error.errno in _LACKS:
        lack = _LACKS[error.errno]
    else:
        return None
    return (
        f"{lack}; free system resources, or raise the limit (ulimit -v, ulimit -u, or the container's), and try again"
    )


def preload_within_limit() -> None:
    """If the address space is limited (ulimit -v), import now what a summary needs. Raises MemoryError if there is no room.

    Later there may be none: OpenBLAS, which scipy.special loads, then asks for memory again and again, for ever.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    try:
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        used = 0
    if limit - used < _SPECIAL_BYTES:
        raise MemoryError
    import_module("scipy.special")
