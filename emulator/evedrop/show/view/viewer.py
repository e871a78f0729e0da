"""The viewer of a run: a window, or a page for browsers; either reads the recording as it is written to disk.

A recording contains the truth, so it is never sent to a port where anybody could fetch it: a window reads it from a pipe, a
browser from an address that cannot be guessed. A window is a process of Rerun's command; the page is served by this process,
from Rerun's files. Neither Rerun nor Zenoh is imported here.

Source: docs/view.md, who sees it.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final
from urllib.parse import quote

from evedrop.errors import UsageError
from evedrop.show.view.viewer_process import HOST, PortTaken, end, executable, is_apart, spawn
from evedrop.system.ports import free_port

if TYPE_CHECKING:
    from evedrop.show.view.growing_recording import Followed, Served
    from evedrop.show.view.web_page import WebPage

_ATTEMPTS = 3
_WINDOW = ("--hide-welcome-screen",)
_DARK = "theme=dark"
"""The page's theme, for which the colours of the panels are made, whatever the browser's theme is."""


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


@final
class Viewer:
    """A running viewer; made by `start` or `serve`.

    A page listens on loopback only unless a WebAddress says otherwise. A window has a session of its own so that Ctrl-C in the
    terminal does not reach it, and on Linux it dies with the thread that started it, however that thread ends.
    """

    def __init__(
        self,
        followed: Followed,
        process: subprocess.Popen[bytes] | None = None,
        servers: Sequence[Served | WebPage] = (),
        address: str | None = None,
    ) -> None:
        """process: a window's; servers and address: a page's."""
        self._followed = followed
        self._process = process
        self._servers = [*servers]
        self._stopped = threading.Event()
        self.address = address
        """The address to open in a browser; None for a window. Anybody who has it sees the truth."""
        self.warning: str | None = None
        """A warning to the user if others can reach the viewer."""
        if process is not None and not is_apart(process):
            self.warning = (
                "other users of this machine can find the window's port, control the window and take pictures of what it "
                "shows, for this system allows it no network of its own; the web view, whose address is a secret, or no view "
                "keeps it from them (docs/view.md, who sees it)"
            )

    @property
    def pid(self) -> int | None:
        """The id of a window's process; None for a page."""
        return None if self._process is None else self._process.pid

    @classmethod
    def start(
        cls, mode: str, logs: Path, recording: Path, complete: bool = False, options: Sequence[str] = _WINDOW
    ) -> Viewer | None:
        """Start a viewer and wait until it is ready; None for "off". A window's output goes to viewer.log in the folder `logs`.

        mode: "native", "web", "off", or "auto". recording: the file to show, from its beginning on and as it grows; it need not
        exist yet. complete: whether the file no longer grows. options: those that a window is started with.

        Raises UsageError if it cannot be started.
        """
        mode = choose(mode)
        if mode == "off":
            return None
        from evedrop.show.view.growing_recording import Followed  # noqa: PLC0415 - only with a view

        followed = Followed(recording, complete)
        if mode == "web":
            return cls._page(followed, HOST, HOST, 0, 0)
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(PortTaken):
                return cls._window(followed, free_port(), logs, options)
        return cls._window(followed, free_port(), logs, options)

    @classmethod
    def serve(cls, web_address: WebAddress, recording: Path, complete: bool = False) -> Viewer:
        """Start a viewer for browsers at a given address; otherwise as `start`.

        Raises UsageError if it cannot be started, for example because a port is taken.
        """
        from evedrop.show.view.growing_recording import Followed  # noqa: PLC0415 - only with a view

        followed = Followed(recording, complete)
        host, seen, port = web_address.host, web_address.seen, web_address.port
        try:
            return cls._page(followed, host, seen, port, port + 1)
        except UsageError as error:
            raise UsageError(f"--serve {host}:{port}: {error}") from error

    @classmethod
    def _page(cls, followed: Followed, host: str, seen: str, port: int, data_port: int) -> Viewer:
        """A page at a port of ours, and the recording at another; 0: any free one."""
        from evedrop.show.view.growing_recording import Served  # noqa: PLC0415 - only with a view
        from evedrop.show.view.rerun_page import RerunPage  # noqa: PLC0415 - the same
        from evedrop.show.view.web_page import WebPage  # noqa: PLC0415 - the same

        rerun = RerunPage(executable())
        served = Served(followed, host, data_port)
        try:
            page = WebPage(rerun, host, port, seen, served.port)
        except BaseException:
            served.stop()
            raise
        data = quote(f"http://{seen}:{served.port}{served.path}", safe="")
        return cls(followed, None, [served, page], f"http://{seen}:{page.port}/?url={data}&{_DARK}")

    @classmethod
    def _window(cls, followed: Followed, port: int, logs: Path, options: Sequence[str]) -> Viewer:
        from evedrop.show.view.growing_recording import feed  # noqa: PLC0415 - only with a view

        arguments = ["--port", str(port), *options, "-"]
        process = spawn(port, arguments, logs, stdin=subprocess.PIPE, apart=not _screen_is_remote())
        assert process.stdin is not None  # noqa: S101 - it is a pipe
        feed(followed, process.stdin)
        return cls(followed, process)

    def alive(self) -> bool:
        """Whether it still runs; a window may have been closed."""
        return self._process.poll() is None if self._process is not None else not self._stopped.is_set()

    def complete(self) -> None:
        """Declare the recording finished; it stays in view."""
        self._followed.complete()

    def stop(self) -> None:
        """End the viewer within seconds. Harmless if it has ended."""
        self._followed.complete()
        self._stopped.set()
        while self._servers:
            self._servers.pop().stop()
        if self._process is not None:
            end(self._process)


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
        return Viewer.serve(web_address, recording, complete=True)
    viewer = Viewer.start(mode, run / "logs", recording, complete=True)
    if viewer is None:
        raise UsageError("a finished run cannot be opened with the view off; give auto, native or web")
    return viewer
