"""Finds free ports on loopback."""

from __future__ import annotations

import secrets
import socket

from evedrop.errors import UsageError


def free_port() -> int:
    """A free TCP port on loopback, below the range that the system uses for outgoing connections."""
    for _ in range(200):
        port = 10_000 + secrets.randbelow(22_000)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise UsageError(
        "no free port between 10000 and 32000 on loopback; end some programs, or give the router's endpoint"
    )
