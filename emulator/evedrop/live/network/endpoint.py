"""Zenoh endpoints, where a router listens and the other processes connect.

`unixsock-stream/PATH` is a Unix socket in a private folder of this machine; `tcp/HOST:PORT` and `tls/HOST:PORT` are ports.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
from dataclasses import dataclass, replace
from pathlib import Path

from evedrop.system.world import world

_FORM = re.compile(r"(tcp|tls)/(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_.-]+)):([0-9]{1,5})")
_MOST_LABEL = 63
_SOCKET = "unixsock-stream"
_MOST_PATH_BYTES = 103  # Linux takes 107, macOS 103
_SEPARATORS = frozenset("?#;")


@dataclass(frozen=True)
class Endpoint:
    """A port of a host."""

    protocol: str
    """`tcp`, unencrypted, or `tls`."""
    host: str
    """A name or an address; an IPv6 address without brackets."""
    port: int

    @classmethod
    def of(cls, text: str) -> Endpoint:
        """Parse the endpoint of a port. Raises ValueError if the text is not one."""
        match = _FORM.fullmatch(text)
        if match is None:
            raise ValueError(f"{text} is not an endpoint")
        protocol, sixth, host, port = match.groups()
        endpoint = cls(protocol, sixth or host, int(port))
        if not 0 < endpoint.port < 2**16:
            raise ValueError(f"{text} names no port")
        if sixth is not None and endpoint.address is None:
            raise ValueError(f"{text} names no address")
        labels = endpoint.host.split(".")
        # The system takes 127.1 and 2130706433 for addresses, and TLS for names that no certificate can have.
        no_name = labels[-1].isdecimal() and endpoint.address is None
        if sixth is None and (no_name or any(not 0 < len(label) <= _MOST_LABEL for label in labels)):
            raise ValueError(f"{text} names no host")
        return endpoint

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}/{host}:{self.port}"

    @property
    def address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
        """The host's address, if the host is given as an address."""
        try:
            return ipaddress.ip_address(self.host)
        except ValueError:
            return None

    @property
    def secure(self) -> bool:
        """Whether messages are encrypted, and both ends show certificates."""
        return self.protocol == "tls"

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host == "localhost" or (self.address is not None and self.address.is_loopback)

    @property
    def everywhere(self) -> bool:
        """Whether it stands for every address of a machine: a router can listen there, but nothing can connect there."""
        return self.address is not None and self.address.is_unspecified

    @property
    def nearby(self) -> Endpoint:
        """The endpoint at which processes of the same machine reach a router that listens here."""
        if not self.everywhere:
            return self
        return replace(self, host="::1" if ":" in self.host else "127.0.0.1")

    def try_to_listen(self) -> None:
        """Raise OSError unless this host can listen there."""
        world().expect_free(self.host, self.port)

    def dial(self, seconds: float) -> socket.socket:
        """Connect to the program that listens there, within this time. Raises OSError."""
        return world().dial((self.host, self.port), seconds)


@dataclass(frozen=True)
class SocketEndpoint:
    """A Unix socket in a folder that no other user can enter: nobody else can listen there, or connect to it."""

    path: Path

    def __str__(self) -> str:
        return f"{_SOCKET}/{self.path}"

    @property
    def secure(self) -> bool:
        """Whether both ends show certificates: they do not, since the folder keeps other users out."""
        return False

    @property
    def nearby(self) -> SocketEndpoint:
        """The endpoint at which processes of the same machine reach a router that listens here."""
        return self

    def try_to_listen(self) -> None:
        """Raise OSError unless the folder of the socket is this user's, and closed to all others.

        Zenoh replaces the socket of a router that was killed.
        """
        folder = self.path.parent.stat()
        if folder.st_uid != os.getuid() or folder.st_mode & 0o077:
            raise PermissionError(errno.EPERM, "other users can enter its folder")

    def dial(self, seconds: float) -> socket.socket:
        """Connect to the program that listens there, within this time. Raises OSError."""
        return world().dial(self.path, seconds)


AnyEndpoint = Endpoint | SocketEndpoint


def endpoint_in(text: str) -> AnyEndpoint:
    """Parse an endpoint of either kind. Raises ValueError if the text is not an endpoint."""
    protocol, _, path = text.partition("/")
    if protocol != _SOCKET:
        return Endpoint.of(text)
    if not can_be_socket(path):
        raise ValueError(f"{text} names no socket")
    return SocketEndpoint(Path(path))


def can_be_socket(path: str) -> bool:
    """Whether a path can be that of a socket: absolute, short, and without characters that separate parts of an endpoint."""
    plain = path.isprintable() and not set(path) & _SEPARATORS
    return path.startswith("/") and plain and len(os.fsencode(path)) <= _MOST_PATH_BYTES
