"""What a viewer is given: the recording as it grows, through a pipe or by HTTP, and for a browser Rerun's page.

Over HTTP only a reader that knows the address of a recording gets it: the address contains a secret. Nothing here can delay a
run: the run writes a file, and separate threads read it; each may wait for its viewer indefinitely.

The page, its script and its program are read from the file of Rerun's command, which contains them as they are; no server of
Rerun runs. Rerun's command could serve them at a port itself, but another user of the machine may take a port first and serve a
page of his own. He cannot change the installed package. Rerun's page loads a font from another host, and its program may ask
others: the page is served without what it loads from there, and the Content-Security-Policy makes the browser refuse both.

Source: docs/view.md, who sees it; Content Security Policy Level 3 (W3C); WebAssembly Core Specification 3.0 (W3C), binary format
of modules.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import mmap
import os
import re
import secrets
import socket
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, final

from evedrop.errors import UsageError
from evedrop.show.view.bounded_http import BoundedServer, QuietHandler
from evedrop.show.view.live_files import LiveFiles
from evedrop.system.lacks import lack_of
from evedrop.system.ports import other_user

_POLL_SECONDS = 0.05  # between two checks of whether the file has grown
_PIECE = 2**18


@final
class Followed:
    """A recording that grows, read from its beginning; it may not exist yet, and its folder may be moved."""

    def __init__(self, path: Path, complete: bool = False) -> None:
        """complete: whether the recording will not grow."""
        self._path = path
        self._files: LiveFiles | None = None
        self._lock = threading.Lock()
        self._over = threading.Event()
        if complete:
            self._over.set()

    def open_early(self) -> None:
        """Open the files as soon as they exist, on a thread: the first reader may come after their folder was moved."""
        if not self._over.is_set() and self._begun() is None:
            threading.Thread(target=self._wait_for_files, name="recording", daemon=True).start()

    def complete(self) -> None:
        """Declare the recording complete: `pieces` then stops at its end."""
        with contextlib.suppress(OSError):
            self._opened()
        self._over.set()

    def pieces(self, left: Callable[[], bool] = lambda: False) -> Iterator[bytes]:
        """The recording so far, in large chunks, then what is added to it, as it comes; waits for more until it is complete.

        left: whether the reader has left, asked while there is nothing to read.
        """
        while (files := self._begun()) is None:
            if left() or (self._over.wait(_POLL_SECONDS) and self._begun() is None):
                return
        *parts, (start, _) = files.spans or [(0, 0)]
        for descriptor, (first, end) in zip(files.descriptors, parts, strict=False):
            at = first
            while piece := os.pread(descriptor, min(_PIECE, end - at), at):
                at += len(piece)
                yield piece
        while True:
            over = self._over.is_set()  # asked before reading, so that no piece written in between is lost
            spans = files.spans
            most = _PIECE if spans is None else min(_PIECE, spans[-1][1] - start)
            piece = os.pread(files.descriptors[-1], most, start)
            if piece:
                start += len(piece)
                yield piece
            elif over or left():
                return
            else:
                self._over.wait(_POLL_SECONDS)

    def _wait_for_files(self) -> None:
        while self._files is None and not self._over.wait(_POLL_SECONDS):
            self._begun()

    def _begun(self) -> LiveFiles | None:
        """The files, as soon as something can be read; None before."""
        with contextlib.suppress(OSError):
            files = self._opened()
            return None if files.spans == [] else files
        return None

    def _opened(self) -> LiveFiles:
        with self._lock:
            if self._files is None:
                self._files = LiveFiles(self._path)
            return self._files


def feed(followed: Followed, pipe: IO[bytes]) -> None:
    """Write a recording into a pipe, on a thread of its own, until the recording ends or the pipe has no reader."""

    def write() -> None:
        with contextlib.suppress(OSError), pipe:
            for piece in followed.pieces():
                pipe.write(piece)

    threading.Thread(target=write, name="view", daemon=True).start()


class _ViewServer(BoundedServer):
    """A server that accepts readers at host and port; port 0: any free one. Raises UsageError if the port is not available."""

    def __init__(self, host: str, port: int, handler: type[QuietHandler]) -> None:
        try:
            super().__init__((host, port), handler)
        except OSError as error:
            raise UsageError(
                f"{host}:{port} cannot be used ({error.strerror}) to show the run; give another"
            ) from error
        self.start()


@final
class Served(_ViewServer):
    """A recording at an address that cannot be guessed.

    Raises UsageError if the port is not available.
    """

    def __init__(self, followed: Followed, host: str, port: int, private: bool = False) -> None:
        """private: only programs of this user get the recording, because its address is written to a file."""
        self.path = f"/{secrets.token_urlsafe(24)}/recording.rrd"
        self.followed, self.private = followed, private
        super().__init__(host, port, _RecordingHandler)


class _RecordingHandler(QuietHandler):
    server: Served

    def do_GET(self) -> None:
        """Send the recording to a reader that knows its address."""
        self.close_connection = True
        unknown = not hmac.compare_digest(self.path.encode(), self.server.path.encode())
        if unknown or (self.server.private and other_user(self.connection) not in {os.getuid(), None}):
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
        for piece in self.server.followed.pieces(self._left):
            self.wfile.write(b"%x\r\n%b\r\n" % (len(piece), piece))
        self.wfile.write(b"0\r\n\r\n")

    def _left(self) -> bool:
        """Whether the reader has closed the connection: its place is then free for another."""
        try:
            return not self.connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True


_LARGEST_TEXT = 2**22
"""In bytes; the page and the script are shorter."""

_MAGIC = b"\0asm\x01\0\0\0"
_ORDER = (1, 2, 3, 4, 5, 13, 6, 7, 8, 9, 12, 10, 11)
"""The ids of a module's sections in the order in which they come; those of the id 0 come anywhere, and begin with a name."""
_NAMED, _CODE = 0, 10
_MOST_SECTIONS = 1000


@final
class RerunPage:
    """The page, the script and the WebAssembly program of an installed Rerun.

    The command's file stays open, so the parts belong together even if another version is installed meanwhile.
    """

    def __init__(self, command: Path) -> None:
        """command: the file of Rerun's command. Raises UsageError if it has no page, OSError if memory is lacking."""
        try:
            self._file = os.open(command, os.O_RDONLY | os.O_CLOEXEC)
            weakref.finalize(self, os.close, self._file)  # when no browser is being served any more
            with mmap.mmap(self._file, 0, access=mmap.ACCESS_READ) as content:
                page = _text(content, b"<!doctype html>", b"re_viewer.js", b"</html>")
                self.script = _text(content, b"let wasm_bindgen", b"WebAssembly", b"\n})(")
                self.program = _program(content)
            self.html = b"".join(self.pieces(page)).decode()
        except (OSError, EOFError, ValueError) as error:
            if lack_of(error) is not None:
                raise
            raise UsageError(
                f"the page of the view cannot be read from {command} ({error}); install a version of rerun-sdk that Evedrop is "
                "tested with (tools/constraints/project.txt), or choose the native view or no view"
            ) from error

    def pieces(self, part: range) -> Iterator[bytes]:
        """`script` or `program`, piece by piece. Raises EOFError if the file has been cut short meanwhile."""
        for at in range(part.start, part.stop, _PIECE):
            piece = os.pread(self._file, min(_PIECE, part.stop - at), at)
            if not piece:
                raise EOFError("the file was cut short")
            yield piece


def _text(content: mmap.mmap, begin: bytes, word: bytes, end: bytes) -> range:
    """Where a text is that begins so, contains a word, and whose last line begins with `end`. Raises ValueError."""
    at = content.find(begin)
    while at >= 0:
        stop = content.find(end, at, at + _LARGEST_TEXT)
        if stop >= 0 and content.find(word, at, stop) >= 0:
            return range(at, content.find(b"\n", stop + 1) + 1)
        at = content.find(begin, at + 1)
    raise ValueError(f"it does not contain {begin.decode()} … {word.decode()}")


def _program(content: mmap.mmap) -> range:
    """Where a WebAssembly module is. Raises ValueError."""
    at = content.find(_MAGIC)
    while at >= 0:
        sections = dict(_sections(content, at + len(_MAGIC)))
        if _CODE in sections:
            return range(at, max(sections.values()))
        at = content.find(_MAGIC, at + 1)
    raise ValueError("it does not contain a WebAssembly module")


def _sections(content: mmap.mmap, at: int) -> Iterator[tuple[int, int]]:
    """The sections from a position on, as far as they can be of one module: the id of each, and its end."""
    following = [*_ORDER]
    for _ in range(_MOST_SECTIONS):
        number = content[at] if at < len(content) else -1
        size, begin = _unsigned(content, at + 1)
        at = begin + size
        if number == _NAMED:
            length, name = _unsigned(content, begin)
            if at > len(content) or name + length > at or not content[name : name + length].isascii() or not length:
                return
        elif number in following and at <= len(content):
            following = following[following.index(number) + 1 :]
        else:
            return
        yield number, at


def _unsigned(content: mmap.mmap, at: int) -> tuple[int, int]:
    """A number in LEB128, and the position after it."""
    number = 0
    for i, byte in enumerate(content[at : at + 5]):
        number |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return number, at + i + 1
    return len(content), at  # there is no number here: no section is so long


_PAGES = ("/", "/index.html")
_SCRIPT, _PROGRAM = "/re_viewer.js", "/re_viewer_bg.wasm"
_PATIENCE_SECONDS = 20.0  # for a browser to take a piece

_LINK = re.compile(r"<link\b[^>]*?https?://[^>]*>", re.IGNORECASE)
_ADDRESS = re.compile(r"""https?://[^\s"'`<>]+""")
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)


_LOOPBACK, _NOWHERE = "http://127.0.0.1:* http://localhost:*", "'none'"
"""Where a page may be shown in a frame; `http:` stands for `https:`, too."""


@final
class WebPage(_ViewServer):
    """The page at an address; it can load recordings from one port of the same host, and nothing from elsewhere.

    Raises UsageError if the port is not available.
    """

    def __init__(
        self, rerun: RerunPage, host: str, port: int, seen: str, recordings: int, framed: bool = False
    ) -> None:
        """host, port: where to listen; port 0: any free one. seen: the host's name for a browser.

        recordings: the port of the recording; framed: whether pages of this machine may show the page in a frame.
        """
        self.rerun, self.html, self.framed = rerun, own_page(rerun.html), framed
        self.recordings = (seen, recordings)
        super().__init__(host, port, _PageHandler)


def own_page(html: str) -> str:
    """Rerun's page without links to other hosts: no font, no statistics, no issue tracker."""
    return _ADDRESS.sub("#", _LINK.sub("", html))


def policy(html: str, recordings: list[str], framed: bool = False) -> str:
    """The Content-Security-Policy of a page: its own scripts, files of its own address, and recordings from these addresses.

    framed: whether pages of this machine, such as a notebook, may show it in a frame.
    """
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
            f"frame-ancestors {_LOOPBACK if framed else _NOWHERE}",
        ]
    )


class _PageHandler(QuietHandler):
    server: WebPage

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
        self.send_header("Content-Security-Policy", policy(self.server.html, self._recordings(), self.server.framed))
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
