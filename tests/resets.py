"""Resets the connections of a process that this one has started, as a system does that drops them; Linux, without root."""

from __future__ import annotations

import ctypes
import os
import socket
from contextlib import closing, suppress
from pathlib import Path

_PIDFD_GETFD = 438  # on every architecture; Python has no name for it
_UNSPECIFIED = bytes(16)  # a socket address of family AF_UNSPEC: to connect to it resets the connection
_LIBC = ctypes.CDLL(None, use_errno=True)


def reset_connections(pid: int, port: int) -> int:
    """Reset every TCP connection that the process has at its own port; how many there were.

    Both ends are told at once. Raises PermissionError where a process may not reach into one that it has started.
    """
    resets, process = 0, os.pidfd_open(pid)
    try:
        for number in _sockets_of(pid):
            own = _LIBC.syscall(_PIDFD_GETFD, process, number, 0)
            if own < 0 and ctypes.get_errno() == 1:
                raise PermissionError("pidfd_getfd")
            if own < 0:  # closed meanwhile
                continue
            with suppress(OSError), closing(socket.socket(fileno=own)) as connection:
                if connection.family == socket.AF_INET and connection.getsockname()[1] == port:
                    connection.getpeername()  # that which listens has no peer, and stays
                    resets += _LIBC.connect(connection.fileno(), _UNSPECIFIED, len(_UNSPECIFIED)) == 0
    finally:
        os.close(process)
    return resets


def _sockets_of(pid: int) -> list[int]:
    sockets = []
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            if os.readlink(path).startswith("socket:"):
                sockets.append(int(path.name))
    return sockets
