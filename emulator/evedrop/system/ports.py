"""Ports on loopback: free ones, and whose programs use them."""

from __future__ import annotations

import socket
import sys
from contextlib import suppress
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.system.world import world


def free_port() -> int:
    """A free TCP port on loopback, below the range that the system uses for outgoing connections."""
    for _ in range(200):
        port = 10_000 + int.from_bytes(world().token(4), "big") % 22_000
        with suppress(OSError):
            world().expect_free("127.0.0.1", port)
            return port
    raise UsageError(
        "no free port between 10000 and 32000 on loopback; end some programs, or give the router's endpoint"
    )


_TABLE = Path("/proc/net/tcp")
_PLACES, _USER = slice(1, 3), 7
"""Columns: the addresses and ports of a socket and of its other end, and the id of the user who opened it."""


def other_user(connection: socket.socket) -> int | None:
    """The id of the user whose program is at the other end of a TCP connection over IPv4 on this machine; -1 if it has left.

    None if the system does not say: only Linux does.
    """
    try:
        lines = _TABLE.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    ends = [_in_table(*end) for end in (connection.getpeername(), connection.getsockname())]
    return next((int(words[_USER]) for words in map(str.split, lines) if words[_PLACES] == ends), -1)


def _in_table(host: str, port: int) -> str:
    return f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"
