"""The page of a view in a browser: Rerun's, without what it loads from other hosts, and with a policy that forbids it.

Rerun's web server runs on loopback, and this module passes on its files. Rerun's page loads a font from another host, and its
program may ask others; the Content-Security-Policy makes the browser refuse both.

Source: docs/view.md, who sees it; Content Security Policy Level 3 (W3C).
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import re
from typing import final

from evedrop.errors import UsageError
from evedrop.view.bounded_http import BoundedServer, QuietHandler

_PAGES = ("/", "/index.html")
_FILES = ("/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico")
_PIECE = 2**18
_PATIENCE_SECONDS = 20.0  # for Rerun's server, and for a browser to take a piece

_LINK = re.compile(r"<link\b[^>]*?https?://[^>]*>", re.IGNORECASE)
_ADDRESS = re.compile(r"""https?://[^\s"'`<>]+""")
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_HOST = re.compile(r"([A-Za-z0-9.-]+)(:\d+)?")


@final
class WebPage:
    """The page at an address; it can load recordings from one port of the same host, and nothing from elsewhere.

    Raises UsageError if the port is not available, or if Rerun's server sends no page.
    """

    def __init__(self, rerun: tuple[str, int], host: str, port: int, seen: str, recordings: int) -> None:
        """rerun: host and port of Rerun's web server. host, port: where to listen. seen: the host's name for a browser.

        recordings: the port of the recording.
        """
        try:
            html = own_page(_page_of(rerun))
        except (OSError, http.client.HTTPException) as error:
            raise UsageError(f"the viewer sends no page ({error}); turn the view off to do without it") from error
        try:
            self._server = _Server(rerun, html, (seen, recordings), host, port)
        except OSError as error:
            raise UsageError(
                f"{host}:{port} cannot be used ({error.strerror}) to show the run; give another"
            ) from error
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
    def __init__(self, rerun: tuple[str, int], html: str, recordings: tuple[str, int], host: str, port: int) -> None:
        self.rerun = rerun
        self.html = html
        self.recordings = recordings
        super().__init__((host, port), _Handler)


class _Handler(QuietHandler):
    server: _Server

    def do_GET(self) -> None:
        """Send the page, or one of the files that it loads."""
        self.close_connection = True
        path = self.path.partition("?")[0]
        self.connection.settimeout(_PATIENCE_SECONDS)
        if path in _PAGES:
            content = self.server.html.encode()
            self._begin(200, "text/html; charset=utf-8", len(content))
            self.wfile.write(content)
        elif path in _FILES:
            self._pass_on(path)
        else:
            self.refuse(404)

    def _pass_on(self, path: str) -> None:
        connection = http.client.HTTPConnection(*self.server.rerun, timeout=_PATIENCE_SECONDS)
        try:
            connection.request("GET", path)
            found = connection.getresponse()
            length = int(found.headers["rerun-final-length"])
        except (OSError, http.client.HTTPException, TypeError, ValueError):
            self.refuse(502)  # the viewer hangs, or has ended
            return
        else:
            self._begin(found.status, found.headers["Content-Type"], length)
            while piece := found.read(_PIECE):
                self.wfile.write(piece)
        finally:
            connection.close()

    def _begin(self, status: int, kind: str, length: int) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Content-Security-Policy", policy(self.server.html, self._recordings()))
        self.send_header("Referrer-Policy", "no-referrer")  # the page's address contains that of the recording
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _recordings(self) -> list[str]:
        """Where recordings come from: the host that was printed, and the name by which this browser knows it."""
        seen, port = self.server.recordings
        asked = _HOST.fullmatch(self.headers.get("Host", ""))
        return [f"http://{host}:{port}" for host in dict.fromkeys([seen, *([asked[1]] if asked else [])])]


def _page_of(rerun: tuple[str, int]) -> str:
    connection = http.client.HTTPConnection(*rerun, timeout=_PATIENCE_SECONDS)
    try:
        connection.request("GET", "/")
        found = connection.getresponse()
        if found.status != 200:
            raise http.client.HTTPException(f"status {found.status}")
        return found.read().decode()
    finally:
        connection.close()
