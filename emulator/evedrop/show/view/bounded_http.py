"""The HTTP server of views in a browser and of metrics: a bounded number of readers, each on its own thread, and no log.

Somebody else's web page can reach a server that listens only on loopback, if the DNS gives the page's host name our address
(DNS rebinding): the browser then treats our answers as part of that page. So a request must name an address, or a
name that cannot exist in the public DNS.

Source: RFC 9110, Section 7.4 (misdirected requests).
"""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

_POLL_SECONDS = 0.05  # between two checks of whether the server is to stop
_REQUEST_SECONDS = 10.0  # for a reader to send its request
_MOST_READERS = 32  # at a time; further ones are turned away, so another user can use up all places

_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([A-Za-z0-9._-]+))(?::[0-9]{1,5})?")
_PRIVATE = (".localhost", ".internal")
"""Domains that the public DNS does not have: RFC 6761, and ICANN's resolution of 29 July 2024."""


def own_host(text: str) -> str | None:
    """The host of a Host header, without the port and in lower case, as it stands in an address; None for a foreign one.

    An address is never foreign, nor is a name without a dot, in a private domain, or of this machine (RFC 6762 for `.local`).
    """
    match = _HOST.fullmatch(text)
    if match is None:
        return None
    if match[1] is not None:
        return f"[{match[1].lower()}]" if _is_address(match[1], 6) else None
    name, machine = match[2].lower(), socket.gethostname().lower()
    of_machine = name in {machine, f"{machine.partition('.')[0]}.local"}
    return name if of_machine or _is_address(name, 4) or "." not in name or name.endswith(_PRIVATE) else None


def _is_address(text: str, version: int) -> bool:
    try:
        return ipaddress.ip_address(text).version == version
    except ValueError:
        return False


class BoundedServer(ThreadingHTTPServer):
    """A server that turns readers away when all places are taken, and waits for no reader when it stops."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], handler: type[QuietHandler]) -> None:
        """Raises OSError if the port is not available."""
        self._places = threading.BoundedSemaphore(_MOST_READERS)
        super().__init__(address, handler)

    def start(self) -> None:
        """Accept readers, on a thread of its own."""
        threading.Thread(target=self.serve_forever, args=(_POLL_SECONDS,), name="http server", daemon=True).start()

    def stop(self) -> None:
        """Accept no more readers. Those in progress continue by themselves."""
        self.shutdown()
        self.server_close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve on a thread, if there is a free place."""
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one reader."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore readers that leave or never send a request."""


class QuietHandler(BaseHTTPRequestHandler):
    """A request. Nothing about it is logged, because the address of a recording is a secret."""

    protocol_version = "HTTP/1.1"
    timeout = _REQUEST_SECONDS
    asked_host = ""
    """The host that the request names, as it stands in an address."""

    def parse_request(self) -> bool:
        """Read the request line and the headers; refuses a request that is malformed or names a foreign host."""
        if not super().parse_request():
            return False
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1:
            self.refuse(400, "a request needs one Host header")
            return False
        host = own_host(hosts[0].strip())
        if host is None:
            self.refuse(421, "this server is not for that name; use the address that Evedrop printed")
            return False
        self.asked_host = host
        return True

    def refuse(self, status: int, why: str = "") -> None:
        """Reply with this status, a sentence if there is one, and nothing else."""
        content = f"{why}\n".encode() if why else b""
        self.close_connection = True
        self.send_response(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Log nothing."""

    def version_string(self) -> str:
        """The program's name without its version."""
        return "evedrop"
