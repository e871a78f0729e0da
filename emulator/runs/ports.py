"""Where the router of a run may listen: a free port on loopback, or what was asked for, if that is safe and can be had."""

from __future__ import annotations

import secrets
import socket
from dataclasses import dataclass

from emulator.errors import UsageError
from emulator.network.endpoint import Endpoint

_EXAMPLE = "give one such as tls/router.lan:7447"


@dataclass(frozen=True)
class Meeting:
    """Where the router listens, and what the others connect to."""

    listen: Endpoint
    connect: Endpoint

    @property
    def secure(self) -> bool:
        """Whether it takes certificates."""
        return self.listen.secure

    @property
    def names(self) -> tuple[str, ...]:
        """The hosts that the router is known by."""
        found = (self.connect.host, *(() if self.listen.everywhere else (self.listen.host,)))
        return tuple(dict.fromkeys(found))


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


def meeting_at(listen: str, connect: str | None = None, insecure: bool = False) -> Meeting:
    """The meeting that `--listen` and `--connect` name, on whichever host.

    insecure: whether the user said that it may be in clear although others can get at it. Raises UsageError if it is no
    place to meet at.
    """
    here = _endpoint("--listen", listen)
    there = here if connect is None else _endpoint("--connect", connect)
    if there.everywhere:
        asked = "--listen" if connect is None else "--connect"
        raise UsageError(
            f"{asked} {there} is every address of a host, and none to connect to; add --connect {there.protocol}/HOST:"
            f"{there.port} with the name or address that the others reach it by"
        )
    if here.protocol != there.protocol:
        raise UsageError(f"--connect {there} is not what --listen {here} speaks; give both as tls/HOST:PORT")
    if there.secure and there.address is not None and there.address.version == 6:
        raise UsageError(
            f"--connect {there}: no certificate can be checked against an address of IPv6; give the host's name"
        )
    if not here.secure and not insecure and not here.loopback:
        raise UsageError(
            f"--listen {here} is in clear, and others than this machine can get at it: they would read everything, and "
            f"could pose as the router; give tls/{str(here).partition('/')[2]}, or add --insecure"
        )
    return Meeting(here, there)


def _endpoint(option: str, text: str) -> Endpoint:
    try:
        return Endpoint.of(text)
    except ValueError as error:
        raise UsageError(f"{option} {error}; {_EXAMPLE}") from error


def loopback_meeting(listen: str | None) -> Meeting:
    """The meeting of a run whose processes are all here: what was asked for, or a free port.

    Raises UsageError unless it can be listened on, on loopback.
    """
    if listen is None:
        return meeting_at(f"tcp/127.0.0.1:{free_port()}")
    try:
        endpoint = Endpoint.of(listen)
    except ValueError as error:
        raise UsageError(f"--listen {error}; give one such as tcp/127.0.0.1:17460") from error
    if not endpoint.loopback:
        raise UsageError(
            f"--listen {listen} is no loopback endpoint; give one such as tcp/127.0.0.1:17460, or start the processes by "
            "hand: evedrop brief"
        )
    meeting = meeting_at(listen)
    try:
        endpoint.try_to_listen()
    except OSError as error:
        raise UsageError(f"--listen {listen}: {error.strerror}; leave it out, and a free port is found") from error
    return meeting
