"""The viewer as a child process of ours, on loopback unless told otherwise. Neither Rerun nor Zenoh is imported here.

Rerun's own ways to start a viewer listen on every interface; its command, told so, does not.
"""

from __future__ import annotations

import importlib.util
import ipaddress
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import quote

from emulator.errors import UsageError
from emulator.runs.environment import viewer_environment
from emulator.runs.folder import make_private, private_opener
from emulator.runs.ports import free_port

_HOST = "127.0.0.1"
_START_SECONDS = 20.0
_STOP_SECONDS = 3.0
_ATTEMPTS = 3

# Rerun's settings as we want them: it reports to nobody what is looked at, and writes nothing into the user's home.
_CONFIG = Path(__file__).with_name("rerun_config")

# Ends the viewer together with us, even if we are killed: PR_SET_PDEATHSIG is 1, and survives exec.
_GUARD = (
    "import ctypes, os, signal, sys; ctypes.CDLL(None).prctl(1, signal.SIGKILL); "
    "os.getppid() == int(sys.argv[1]) or sys.exit(1); os.execv(sys.argv[2], sys.argv[2:])"
)


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose(mode: str) -> str:
    """One of "native", "web" and "off", from these or "auto": native with a screen, else web.

    Raises UsageError for any other word, and for "native" without a screen.
    """
    if mode == "auto":
        return "native" if has_screen() else "web"
    if mode not in {"native", "web", "off"}:
        raise UsageError(f"--view {mode} is no way to view a run; give auto, native, web or off")
    if mode == "native" and not has_screen():
        raise UsageError(
            "--view native needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; give --view web, and open "
            "the address it prints in a browser"
        )
    return mode


@dataclass(frozen=True)
class Stand:
    """Where browsers find a view: the page at a port, and what it shows at the next one."""

    host: str
    port: int

    @classmethod
    def of(cls, text: str) -> Stand:
        """From HOST:PORT. Raises UsageError if it is none."""
        host, _, port = text.rpartition(":")
        try:
            address, number = ipaddress.IPv4Address(host), int(port)
        except ValueError:
            number = 0
        if not 0 < number < 2**16 - 1:
            raise UsageError(f"--serve {text} is no address and port; give one such as 127.0.0.1:17450")
        return cls(str(address), number)

    @property
    def seen(self) -> str:
        """The address to type into a browser of this machine."""
        return _HOST if self.host == "0.0.0.0" else self.host  # noqa: S104 - what was asked for

    def check_free(self) -> None:
        """Raise UsageError if somebody else is there: he would be taken for the viewer."""
        for port in (self.port, self.port + 1):
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind((self.host, port))
                except OSError as error:
                    raise UsageError(
                        f"--serve {self.host}:{self.port}: {self.host}:{port} cannot be had ({error.strerror}); give another"
                    ) from error


class Viewer:
    """A running viewer. Final; made by `start`.

    It listens on loopback only unless a stand says otherwise, in a session of its own so that Ctrl-C in the terminal does
    not reach it, and on Linux it dies with the thread that started it, however that ends.
    """

    def __init__(self, process: subprocess.Popen[bytes], port: int, web_port: int | None, host: str = _HOST) -> None:
        self._process = process
        self.url = f"rerun+http://{host}:{port}/proxy"
        """Where a recording is streamed to."""
        self.address = None if web_port is None else f"http://{host}:{web_port}/?url={quote(self.url, safe='')}"
        """What to open in a browser; None for a window."""

    @classmethod
    def start(cls, mode: str, logs: Path, files: Sequence[Path] = ()) -> Viewer | None:
        """Start one and wait until it listens; None for "off". Its output goes to viewer.log in the folder `logs`.

        mode: "native", "web", "off", or "auto". files: recordings to open.

        Raises UsageError if it cannot be started.
        """
        mode = choose(mode)
        if mode == "off":
            return None
        for attempt in range(_ATTEMPTS):
            port, web_port = free_port(), free_port() if mode == "web" else None
            arguments = ["--serve-web", "--web-viewer-port", str(web_port)] if web_port else ["--hide-welcome-screen"]
            try:
                process = spawn(port, [*arguments, *map(str, files)], logs, web_port=web_port)
            except UsageError:
                # Somebody may have taken a port between our look and the viewer's.
                if attempt == _ATTEMPTS - 1:
                    raise
                continue
            return cls(process, port, web_port)
        return None

    @classmethod
    def serve(cls, stand: Stand, logs: Path, files: Sequence[Path] = ()) -> Viewer:
        """Start one for browsers, at a place that is known beforehand.

        Raises UsageError if it cannot be started, for one because the place is taken.
        """
        stand.check_free()
        arguments = ["--serve-web", "--web-viewer-port", str(stand.port), *map(str, files)]
        process = spawn(stand.port + 1, arguments, logs, web_port=stand.port, host=stand.host)
        return cls(process, stand.port + 1, stand.port, stand.seen)

    def alive(self) -> bool:
        """Whether it still runs; a window may have been closed."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Return when it has ended by itself."""
        self._process.wait()

    def stop(self) -> None:
        """End it, for certain within seconds. Harmless if it has ended."""
        end(self._process)


def open_run(run: Path, mode: str, stand: Stand | None = None, recording: Path | None = None) -> Viewer:
    """A viewer with the recording of a results folder, or another of the same run; for browsers, at a stand if there is one.

    Raises UsageError if there is none, or no viewer can be started.
    """
    recording = run / "recording.rrd" if recording is None else recording
    if not recording.is_file():
        raise UsageError(f"{recording} does not exist; give the results folder of a run made without --view off")
    if stand is not None:
        return Viewer.serve(stand, run / "logs", [recording])
    viewer = Viewer.start(mode, run / "logs", [recording])
    if viewer is None:
        raise UsageError("a finished run cannot be opened with --view off; give auto, native or web")
    return viewer


def spawn(
    port: int,
    arguments: Sequence[str],
    logs: Path,
    *,
    web_port: int | None = None,
    host: str = _HOST,
    environment: Mapping[str, str] | None = None,
) -> subprocess.Popen[bytes]:
    """Rerun's command with these arguments, listening on a port of `host`; returns when it does, on web_port too.

    Raises UsageError, with the last lines of its log, if it ends before or does not get there in time.
    """
    command = [str(executable()), "--bind", host, "--port", str(port), *arguments]
    if sys.platform == "linux":
        command = [sys.executable, "-I", "-S", "-c", _GUARD, str(os.getpid()), *command]
    with _log(logs) as log:
        start = log.tell()
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**viewer_environment(), "XDG_CONFIG_HOME": str(_CONFIG), **(environment or {})},
        )
        try:
            if all(_listens(process, host, awaited) for awaited in (port, web_port) if awaited):
                return process
        except BaseException:
            end(process)
            raise
        found = f"ended with status {process.poll()}" if process.poll() is not None else "did not get ready"
        end(process)
        log.seek(start)
        last = log.read().decode(errors="replace").strip().splitlines()[-5:]
    raise UsageError("\n".join([f"the viewer {found}; give --view off to do without. Its last words:", *last]))


def end(process: subprocess.Popen[bytes]) -> None:
    """Terminate a viewer, kill it if it does not listen, and wait for its end."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()


def executable() -> Path:
    """Rerun's command. Raises UsageError if rerun-sdk is not installed."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise UsageError("the viewer is not installed; install rerun-sdk, or give --view off")
    folder = Path(found.origin).parent
    return folder / ("rerun.exe" if sys.platform == "win32" else "rerun")


def _listens(process: subprocess.Popen[bytes], host: str, port: int) -> bool:
    deadline = time.monotonic() + _START_SECONDS
    while process.poll() is None and time.monotonic() < deadline:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            if probe.connect_ex((host, port)) == 0:
                return True
        time.sleep(0.02)
    return False


def _log(logs: Path) -> IO[bytes]:
    """The log file, or a nameless one if a finished run's folder may not be written to."""
    try:
        make_private(logs)
        return open(logs / "viewer.log", "a+b", opener=private_opener)
    except OSError:
        return tempfile.TemporaryFile()
