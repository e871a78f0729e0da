"""A recording that is still being written, passed on to a viewer as it grows: through a pipe, or by HTTP to a browser.

Over HTTP only a reader that knows the address of a recording gets it: the address contains a secret. Nothing here can delay a
run: the run writes a file, and separate threads read it; each may wait for its viewer indefinitely.
"""

from __future__ import annotations

import contextlib
import hmac
import os
import secrets
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, final

from evedrop.errors import UsageError
from evedrop.show.view.bounded_http import BoundedServer, QuietHandler

_POLL_SECONDS = 0.05  # between two checks of whether the file has grown
_PIECE = 2**18


@final
class Followed:
    """A file that grows, read from its beginning; it may not exist yet, and it may be moved."""

    def __init__(self, path: Path, complete: bool = False) -> None:
        """complete: whether the file will not grow."""
        self._path = path
        self._file: int | None = None
        self._lock = threading.Lock()
        self._over = threading.Event()
        if complete:
            self._over.set()

    def complete(self) -> None:
        """Declare the file complete: `pieces` then stops at its end."""
        with contextlib.suppress(OSError):
            self._opened()
        self._over.set()

    def pieces(self) -> Iterator[bytes]:
        """The contents of the file, piece by piece as it grows; waits for more until the file is complete."""
        at = 0
        while True:
            over = self._over.is_set()  # asked before reading, so that no piece written in between is lost
            piece = self._read(at)
            if piece:
                at += len(piece)
                yield piece
            elif over:
                return
            else:
                self._over.wait(_POLL_SECONDS)

    def _read(self, at: int) -> bytes:
        try:
            return os.pread(self._opened(), _PIECE, at)
        except OSError:
            return b""

    def _opened(self) -> int:
        with self._lock:
            if self._file is None:
                self._file = os.open(self._path, os.O_RDONLY)
            return self._file


def feed(followed: Followed, pipe: IO[bytes]) -> None:
    """Write a recording into a pipe, on a thread of its own, until the recording ends or the pipe has no reader."""

    def write() -> None:
        with contextlib.suppress(OSError), pipe:
            for piece in followed.pieces():
                pipe.write(piece)

    threading.Thread(target=write, name="view", daemon=True).start()


@final
class Served:
    """A recording at an address that cannot be guessed.

    Raises UsageError if the port is not available.
    """

    def __init__(self, followed: Followed, host: str, port: int) -> None:
        self.path = f"/{secrets.token_urlsafe(24)}/recording.rrd"
        try:
            self._server = _Server(followed, self.path, host, port)
        except OSError as error:
            raise UsageError(
                f"{host}:{port} cannot be used ({error.strerror}) to show the run; give another"
            ) from error
        self.port = int(self._server.server_address[1])
        self._server.start()

    def stop(self) -> None:
        """Accept no more readers. Those in progress continue by themselves."""
        self._server.stop()


class _Server(BoundedServer):
    def __init__(self, followed: Followed, path: str, host: str, port: int) -> None:
        self.followed = followed
        self.path = path.encode()
        super().__init__((host, port), _Handler)


class _Handler(QuietHandler):
    server: _Server

    def do_GET(self) -> None:
        """Send the recording to a reader that knows its address."""
        self.close_connection = True
        if not hmac.compare_digest(self.path.encode(), self.server.path):
            self.refuse(404)
            return
        self.connection.settimeout(None)  # a browser whose user has paused it may wait indefinitely
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Access-Control-Allow-Origin", "*")  # the page is at another port; the address is the secret
        self.send_header("Cache-Control", "no-store")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        for piece in self.server.followed.pieces():
            self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
        self.wfile.write(b"0\r\n\r\n")
