"""The page of a view in a browser: Rerun's, without what it loads from other hosts, and with a policy that forbids it.

Its files come from the installed Rerun; no server of Rerun runs. Rerun's page loads a font from another host, and its program
may ask others; the Content-Security-Policy makes the browser refuse both.

Source: docs/view.md, who sees it; Content Security Policy Level 3 (W3C).
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable
from typing import final

from evedrop.errors import UsageError
from evedrop.show.view.bounded_http import BoundedServer, QuietHandler
from evedrop.show.view.rerun_page import RerunPage

_PAGES = ("/", "/index.html")
_SCRIPT, _PROGRAM = "/re_viewer.js", "/re_viewer_bg.wasm"
_PATIENCE_SECONDS = 20.0  # for a browser to take a piece

_LINK = re.compile(r"<link\b[^>]*?https?://[^>]*>", re.IGNORECASE)
_ADDRESS = re.compile(r"""https?://[^\s"'`<>]+""")
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)


@final
class WebPage:
    """The page at an address; it can load recordings from one port of the same host, and nothing from elsewhere.

    Raises UsageError if the port is not available.
    """

    def __init__(self, rerun: RerunPage, host: str, port: int, seen: str, recordings: int) -> None:
        """host, port: where to listen; port 0: any free one. seen: the host's name for a browser.

        recordings: the port of the recording.
        """
        try:
            self._server = _Server(rerun, (seen, recordings), host, port)
        except OSError as error:
            raise UsageError(
                f"{host}:{port} cannot be used ({error.strerror}) to show the run; give another"
            ) from error
        self.port = int(self._server.server_address[1])
        self._server.start()

    def stop(self) -> None:
        """Accept no more browsers."""
        self._server.stop()


def own_page(html: str) -> str:
    """Rerun's page without links to other hosts: no font, no statistics, no issue tracker."""
    return _ADDRESS.sub("#", _LINK.sub("", html))


def policy(html: str, recordings: list[str]) -> str:
    """The Content-Security-Policy of a page: its own scripts, files of its own address, and recordings from these addresses."""
    digests = [hashlib.sha256(script.encode()).digest() for script in _INLINE.findall(html)]
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src 'self' 'wasm-unsafe-eval' {scripts}".rstrip(),
            "style-src 'unsafe-inline'",
            "img-src 'self' data: blob:",
            " ".join(["connect-src 'self'", *recordings]),
            "worker-src 'self' blob:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        ]
    )


class _Server(BoundedServer):
    def __init__(self, rerun: RerunPage, recordings: tuple[str, int], host: str, port: int) -> None:
        self.rerun = rerun
        self.html = own_page(rerun.html)
        self.recordings = recordings
        super().__init__((host, port), _Handler)


class _Handler(QuietHandler):
    server: _Server

    def do_GET(self) -> None:
        """Send the page, or one of the files that it loads."""
        self.close_connection = True
        path = self.path.partition("?")[0]
        self.connection.settimeout(_PATIENCE_SECONDS)
        rerun = self.server.rerun
        if path in _PAGES:
            content = self.server.html.encode()
            self._send("text/html; charset=utf-8", len(content), [content])
        elif path == _SCRIPT:
            self._send("text/javascript", len(rerun.script), rerun.pieces(rerun.script))
        elif path == _PROGRAM:
            self._send("application/wasm", len(rerun.program), rerun.pieces(rerun.program))
        else:
            self.refuse(404)

    def _send(self, kind: str, length: int, pieces: Iterable[bytes]) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Content-Security-Policy", policy(self.server.html, self._recordings()))
        self.send_header("Referrer-Policy", "no-referrer")  # the page's address contains that of the recording
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        for piece in pieces:
            self.wfile.write(piece)

    def _recordings(self) -> list[str]:
        """Where recordings come from: the host that was printed, and the name by which this browser knows it."""
        seen, port = self.server.recordings
        return [f"http://{host}:{port}" for host in dict.fromkeys([seen, self.asked_host])]
