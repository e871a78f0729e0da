"""The viewer of a run: a window, or a page for browsers; either reads the recording as it is written to disk.

A recording contains the truth, so it is never sent to a port where anybody could fetch it: a window reads it from a pipe, a
browser from an address that cannot be guessed. Neither Rerun nor Zenoh is imported here.

Source: docs/view.md, who sees it.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final
from urllib.parse import quote

from evedrop.errors import UsageError
from evedrop.ports import free_port
from evedrop.view.viewer_process import HOST, end, is_apart, spawn

if TYPE_CHECKING:
    from evedrop.view.growing_recording import Followed, Served
    from evedrop.view.web_page import WebPage

_ATTEMPTS = 3
_WINDOW = ("--hide-welcome-screen",)
_DARK = "theme=dark"
"""The page's theme, for which the colours of the panels are made, whatever the browser's theme is."""
_NOTHING = f"rerun+http://{HOST}:9/proxy"
"""The page's default source: with it Rerun serves only the page, and opens no port for recordings."""


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose(mode: str) -> str:
    """One of "native", "web" and "off", from these or "auto": native with a screen, otherwise web.

    Raises UsageError for any other word, and for "native" without a screen.
    """
    if mode == "auto":
        return "native" if has_screen() else "web"
    if mode not in {"native", "web", "off"}:
        raise UsageError(f"{mode} is not a way to view a run; give auto, native, web or off")
    if mode == "native" and not has_screen():
        raise UsageError(
            "a native view needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; choose the web view, and open "
            "the address it prints in a browser"
        )
    return mode


@dataclass(frozen=True)
class WebAddress:
    """The address of a view for browsers: the page at this port, its data at the next."""

    host: str
    port: int

    @classmethod
    def of(cls, text: str) -> WebAddress:
        """Parse HOST:PORT. Raises UsageError if the text is malformed."""
        host, _, port = text.rpartition(":")
        try:
            address, number = ipaddress.IPv4Address(host), int(port)
        except ValueError:
            number = 0
        if not 0 < number < 2**16 - 1:
            raise UsageError(f"--serve {text} is not an address and port; give one such as 127.0.0.1:17450")
        return cls(str(address), number)

    @property
    def seen(self) -> str:
        """The address to type into a browser of this machine."""
        return HOST if self.host == "0.0.0.0" else self.host  # noqa: S104 - what was asked for

    def check_free(self) -> None:
        """Raise UsageError if a port is in use: its owner would be mistaken for the viewer."""
        for port in (self.port, self.port + 1):
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((self.host, port))
                except OSError as error:
                    raise UsageError(
                        f"--serve {self.host}:{self.port}: {self.host}:{port} cannot be used ({error.strerror}); give another"
                    ) from error


@final
class Viewer:
    """A running viewer; made by `start` or `serve`.

    It listens on loopback only unless a WebAddress says otherwise, in a session of its own so that Ctrl-C in the terminal does
    not reach it, and on Linux it dies with the thread that started it, however that thread ends.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        followed: Followed,
        servers: Sequence[Served | WebPage] = (),
        address: str | None = None,
    ) -> None:
        self._process = process
        self._followed = followed
        self._servers = [*servers]
        self.address = address
        """The address to open in a browser; None for a window. Anybody who has it sees the truth."""
        self.warning: str | None = None
        """A warning to the user if others can reach the viewer."""
        if address is None and not is_apart(process):
            self.warning = (
                "other users of this machine can find the window's port, control the window and take pictures of what it "
                "shows, for this system allows it no network of its own; the web view, whose address is a secret, or no view "
                "keeps it from them (docs/view.md, who sees it)"
            )

    @property
    def pid(self) -> int:
        """The id of the viewer's process."""
        return self._process.pid

    @classmethod
    def start(
        cls, mode: str, logs: Path, recording: Path, complete: bool = False, options: Sequence[str] = _WINDOW
    ) -> Viewer | None:
        """Start a viewer and wait until it is ready; None for "off". Its output goes to viewer.log in the folder `logs`.

        mode: "native", "web", "off", or "auto". recording: the file to show, from its beginning on and as it grows; it need not
        exist yet. complete: whether the file no longer grows. options: those that a window is started with.

        Raises UsageError if it cannot be started.
        """
        mode = choose(mode)
        if mode == "off":
            return None
        from evedrop.view.growing_recording import Followed  # noqa: PLC0415 - only with a view

        followed = Followed(recording, complete)
        if mode == "web":
            return _repeatedly(lambda: cls._page(followed, HOST, HOST, free_port(), free_port(), logs))
        return _repeatedly(lambda: cls._window(followed, free_port(), logs, options))

    @classmethod
    def serve(cls, web_address: WebAddress, logs: Path, recording: Path, complete: bool = False) -> Viewer:
        """Start a viewer for browsers at a given address; otherwise as `start`.

        Raises UsageError if it cannot be started, for example because a port is taken.
        """
        from evedrop.view.growing_recording import Followed  # noqa: PLC0415 - only with a view

        web_address.check_free()
        followed = Followed(recording, complete)
        host, seen, port = web_address.host, web_address.seen, web_address.port
        return _repeatedly(lambda: cls._page(followed, host, seen, port, port + 1, logs))

    @classmethod
    def _page(cls, followed: Followed, host: str, seen: str, port: int, data_port: int, logs: Path) -> Viewer:
        from evedrop.view.growing_recording import Served  # noqa: PLC0415 - only with a view
        from evedrop.view.web_page import WebPage  # noqa: PLC0415 - the same

        served = Served(followed, host, data_port)
        try:
            rerun = free_port()
            process = spawn(rerun, ["--serve-web", "--web-viewer-port", str(rerun), _NOTHING], logs)
            try:
                page = WebPage((HOST, rerun), host, port, seen, data_port)
            except BaseException:
                end(process)
                raise
        except BaseException:
            served.stop()
            raise
        data = quote(f"http://{seen}:{data_port}{served.path}", safe="")
        return cls(process, followed, [served, page], f"http://{seen}:{port}/?url={data}&{_DARK}")

    @classmethod
    def _window(cls, followed: Followed, port: int, logs: Path, options: Sequence[str]) -> Viewer:
        from evedrop.view.growing_recording import feed  # noqa: PLC0415 - only with a view

        arguments = ["--port", str(port), *options, "-"]
        process = spawn(port, arguments, logs, stdin=subprocess.PIPE, apart=not _screen_is_remote())
        assert process.stdin is not None  # noqa: S101 - it is a pipe
        feed(followed, process.stdin)
        return cls(process, followed)

    def alive(self) -> bool:
        """Whether it still runs; a window may have been closed."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Return when the viewer has ended by itself."""
        self._process.wait()

    def complete(self) -> None:
        """Declare the recording finished; it stays in view."""
        self._followed.complete()

    def stop(self) -> None:
        """End the viewer within seconds. Harmless if it has ended."""
        self._followed.complete()
        while self._servers:
            self._servers.pop().stop()
        end(self._process)


def _repeatedly(open_viewer: Callable[[], Viewer]) -> Viewer:
    """Try several times, because another process may take a port after it was found free."""
    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(UsageError):
            return open_viewer()
    return open_viewer()


def _screen_is_remote() -> bool:
    """Whether the screen is reached over the network, as with `ssh -X`; a window in a separate network could not use it."""
    display = os.environ.get("DISPLAY", "")
    return not os.environ.get("WAYLAND_DISPLAY") and not display.startswith((":", "/", "unix:"))


def open_run(run: Path, mode: str, web_address: WebAddress | None = None, recording: Path | None = None) -> Viewer:
    """Start a viewer of the recording of a results folder, or of another recording; with `web_address`, for browsers there.

    Raises UsageError if there is no recording, or no viewer can be started.
    """
    recording = run / "recording.rrd" if recording is None else recording
    if not recording.is_file():
        raise UsageError(f"{recording} does not exist; give the results folder of a run made with a view")
    if web_address is not None:
        return Viewer.serve(web_address, run / "logs", recording, complete=True)
    viewer = Viewer.start(mode, run / "logs", recording, complete=True)
    if viewer is None:
        raise UsageError("a finished run cannot be opened with the view off; give auto, native or web")
    return viewer
