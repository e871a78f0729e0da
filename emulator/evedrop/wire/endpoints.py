"""Endpoints of sides: their form, and which of them would clash.

Source: docs/wire.md, sides.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from evedrop.scenario.table import expected
from evedrop.scenario.words import listed

RELIABLE = ("tcp", "tls", "quic", "ws", "unixsock-stream")
"""The protocols on which nothing is lost; one that loses by itself would hide what the wire loses."""
ENCRYPTED = frozenset({"tls", "quic"})
FREE = "tcp/127.0.0.1:0"
"""Any free port of the loopback interface."""
_ENDPOINT = re.compile(r"([a-z0-9-]+)/([^?#]+)(?:[?#].*)?")
_HOST_AND_PORT = re.compile(r"(\[[0-9a-fA-F:.%a-z]+\]|[^:\[\]/]+):(\d{1,5})")
_EVERY_HOST = frozenset({"0.0.0.0", "[::]"})  # noqa: S104 - recognised, not bound
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|\[::1\]|localhost")


class EndpointPlace(NamedTuple):
    """Where an endpoint is."""

    protocol: str
    host: str
    """The host, or the path of a socket."""
    port: int | None
    """None for a socket in the file system."""

    @property
    def loopback(self) -> bool:
        """Whether only programs on this machine can reach it."""
        return self.port is None or _LOOPBACK.fullmatch(self.host) is not None

    def overlaps(self, other: EndpointPlace) -> bool:
        """Whether a program that listens on one keeps others from listening on the other."""
        if (self.port is None) != (other.port is None) or (self.protocol == "quic") != (other.protocol == "quic"):
            return False
        if self.port is None:
            return self.host == other.host
        same = self.host == other.host or bool({self.host, other.host} & _EVERY_HOST)
        return self.port == other.port != 0 and same


def place_of(endpoint: str) -> EndpointPlace | None:
    """The place of an endpoint; None if it is malformed."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or found[1] not in RELIABLE:
        return None
    if found[1] == "unixsock-stream":
        return EndpointPlace(found[1], found[2], None)
    address = _HOST_AND_PORT.fullmatch(found[2])
    if address is None or int(address[2]) > 65_535:
        return None
    host = "127.0.0.1" if address[1] == "localhost" else address[1]
    return EndpointPlace(found[1], host, int(address[2]))


def checked_endpoint(endpoint: str) -> str:
    """The endpoint, if its form is right; otherwise raises the error of a check."""
    if endpoint.startswith("udp/"):
        raise expected(f"{listed(RELIABLE)} in place of udp, which would lose messages of its own")
    if place_of(endpoint) is None:
        raise expected(f"PROTOCOL/HOST:PORT with the protocol {listed(RELIABLE)}, such as tcp/127.0.0.1:7448")
    return endpoint
