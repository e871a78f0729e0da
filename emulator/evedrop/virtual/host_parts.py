"""The parts of other hosts, as faults and events name them.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from evedrop.names import RELAY, ROUTER

SSH, PROGRAM, SESSION, HOST_FORK_SERVER = "ssh", "evedrop host", "sshd", "fork server"
"""Processes: the launcher's client, the program that starts processes there, the server's, and the program's fork server."""
CONNECTION, MACHINE, HOST_DISK = "connection", "machine", "disk"
LISTENS = {ROUTER: "tcp/router.lan:7447", RELAY: "tcp/relay.lan:7448"}
"""Where routers listen in runs with other hosts."""
_ON_HOST = " of host "


def part_on(part: str, host: str) -> str:
    """A part of a host, as faults and events name it."""
    return f"{part}{_ON_HOST}{host}"


def host_of(target: str) -> str:
    """The host whose part this is; empty if it is none."""
    return target.partition(_ON_HOST)[2]


def part_of(target: str) -> str:
    """The part of a host; the text itself if it is none."""
    return target.partition(_ON_HOST)[0]
