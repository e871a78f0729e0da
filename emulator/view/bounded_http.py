"""The HTTP server of views in a browser and of metrics: a bounded number of readers, each on its own thread, and no log."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

_LOOK_SECONDS = 0.05  # between two checks of whether the server is to stop
_REQUEST_SECONDS = 10.0  # for a reader to send its request
_MOST_READERS = 32  # at a time; further ones are turned away, so another user can use up all places


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
        threading.Thread(target=self.serve_forever, args=(_LOOK_SECONDS,), name="http server", daemon=True).start()

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

    def refuse(self, status: int) -> None:
        """Reply with this status and nothing else."""
        self.close_connection = True
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Log nothing."""

    def version_string(self) -> str:
        """The program's name without its version."""
        return "evedrop"
