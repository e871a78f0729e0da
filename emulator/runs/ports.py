"""Ports on loopback: a free one, or whether the one that was asked for is."""

from __future__ import annotations

import secrets
import socket

from emulator.errors import UsageError


def free_port() -> int:
    """A free TCP port on loopback, below those that the system hands out for outgoing connections."""
    for _ in range(200):
        port = 10_000 + secrets.randbelow(22_000)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise UsageError("no free port between 10000 and 32000 on loopback; end some programs, or give --listen")


def check_endpoint(endpoint: str) -> None:
    """Raise UsageError unless the endpoint tcp/HOST:PORT can be listened on, on loopback."""
    address = endpoint.removeprefix("tcp/")
    host, _, port = address.rpartition(":")
    named = port.isdecimal() and len(port) <= 5 and 0 < int(port) < 2**16
    if not endpoint.startswith("tcp/") or not named or host not in {"127.0.0.1", "localhost", "[::1]"}:
        raise UsageError(f"--listen {endpoint} is no loopback endpoint; give one such as tcp/127.0.0.1:17460")
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host.strip("[]"), int(port)))
        except OSError as error:
            raise UsageError(
                f"--listen {endpoint}: {error.strerror}; leave it out, and a free port is found"
            ) from error
