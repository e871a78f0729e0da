"""Zenoh endpoints, `tcp/HOST:PORT` or `tls/HOST:PORT`: a router listens there, and the other processes connect there."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass, replace

_FORM = re.compile(r"(tcp|tls)/(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9_.-]+)):([0-9]{1,5})")
_MOST_LABEL = 63


@dataclass(frozen=True)
class Endpoint:
    """The parts of an endpoint."""

    protocol: str
    """`tcp`, unencrypted, or `tls`."""
    host: str
    """A name or an address; an IPv6 address without brackets."""
    port: int

    @classmethod
    def of(cls, text: str) -> Endpoint:
        """Parse an endpoint. Raises ValueError if the text is not an endpoint."""
        found = _FORM.fullmatch(text)
        if found is None:
            raise ValueError(f"{text} is not an endpoint")
        protocol, sixth, host, port = found.groups()
        endpoint = cls(protocol, sixth or host, int(port))
        if not 0 < endpoint.port < 2**16:
            raise ValueError(f"{text} names no port")
        if sixth is not None and endpoint.address is None:
            raise ValueError(f"{text} names no address")
        if any(not 0 < len(label) <= _MOST_LABEL for label in endpoint.host.split(".")) and sixth is None:
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
        found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
