"""The viewer of a run: a window, or a page for browsers; either reads the recording as it is written to disk.

A recording contains the truth, so it is never sent to a port where anybody could fetch it: a window reads it from a pipe, a
browser from an address that cannot be guessed. The page is served by this process, from Rerun's files. A window is a child
process of Rerun's command. Rerun's own functions start viewers that listen on every interface; with its command, the interface
can be chosen. A viewer whose port another process has taken sends that process all it is given to show. So we give it nothing
before it is known that the viewer itself listens. Neither Rerun nor Zenoh is imported here.

Source: docs/view.md, who sees it.
"""

from __future__ import annotations

import contextlib
import importlib.util
import ipaddress
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, final
from urllib.parse import quote

from evedrop.errors import UsageError
from evedrop.results.folder import make_private
from evedrop.system.disk import private_opener
from evedrop.system.environment import viewer_environment
from evedrop.system.parents import signalled_when_parent_dies
from evedrop.system.ports import free_port
from evedrop.system.processes import kill, wait_for

if TYPE_CHECKING:
    from evedrop.show.view.serving import Followed, Served, WebPage


HOST = "127.0.0.1"
NOTEBOOK = "notebook"
"""The view as a page that notebooks of this machine can show in a frame."""
_LSOF = "/usr/sbin/lsof"
_START_SECONDS = 120.0
_ATTEMPTS = 3
_STOP_SECONDS = 3.0
_FOREIGN_PROBES = 5
"""How often in succession a port must belong to another process before a viewer is given up."""

# Rerun's settings: it reports no usage statistics, and writes nothing to the user's home.
_CONFIG = Path(__file__).with_name("rerun_config")

# A window listens on a port for commands and requests for pictures, without authentication. With a network namespace of its
# own, which has only a loopback interface, no other user can reach it. Where the system does not allow that, it runs without.
_APART = """
def apart():
    import fcntl, socket, struct
    user, group = os.getuid(), os.getgid()
    if ctypes.CDLL(None).unshare(0x10000000 | 0x40000000):  # CLONE_NEWUSER, CLONE_NEWNET
        raise OSError
    for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        with open(f"/proc/self/{name}", "w", encoding="ascii") as file:
            file.write(text)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        flags = struct.unpack("16sh14x", fcntl.ioctl(any_socket, 0x8913, struct.pack("16sh14x", b"lo", 0)))[1]
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", flags | 1))  # up

def allowed():
    tried = os.fork()  # half a network would be worse than none
    if tried == 0:
        try:
            apart()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitpid(tried, 0)[1] == 0

if allowed():
    apart()
"""


class PortTaken(UsageError):
    """Another process listens at the port that a viewer was to have."""


def guarded(command: Sequence[str], apart: bool = False) -> list[str]:
    """A command that ends with this process, on Linux; apart: with a network of its own, if the system allows it."""
    return signalled_when_parent_dies(command, signal.SIGKILL, _APART if apart else "")


def is_apart(process: subprocess.Popen[bytes]) -> bool:
    """Whether a process has a network of its own, so that no other process can connect to it."""
    with contextlib.suppress(OSError):
        return os.readlink(f"/proc/{process.pid}/ns/net") != os.readlink("/proc/self/ns/net")
    return False


def spawn(
    port: int,
    arguments: Sequence[str],
    logs: Path,
    *,
    stdin: int = subprocess.DEVNULL,
    apart: bool = False,
    environment: Mapping[str, str] | None = None,
    meanwhile: Callable[[], None] = lambda: None,
) -> subprocess.Popen[bytes]:
    """Start Rerun's command with these arguments, only on loopback; returns when it listens on `port`.

    arguments: must not name what is to be shown, for another process may have taken the port. apart: with a network of its own,
    if the system allows it. meanwhile: called while waiting.

    Raises PortTaken if another process listens there, and UsageError if it ends first or is not ready in time: with the driver
    that it lacks, or the last lines of its log.
    """
    with _log(logs) as log:
        start = log.tell()
        process = subprocess.Popen(
            guarded([str(executable()), "--bind", HOST, *arguments], apart),
            bufsize=0,
            stdin=stdin,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**viewer_environment(), "XDG_CONFIG_HOME": str(_CONFIG), **(environment or {})},
        )
        try:
            if _listens(process, port, meanwhile):
                return process
        except BaseException:
            _give_up(process)
            raise
        problem = f"ended with status {process.poll()}" if process.poll() is not None else "was not ready in time"
        _give_up(process)
        log.seek(start)
        text = log.read().decode(errors="replace")
    if (why := without_driver(text)) is not None:
        raise UsageError(why)
    last = text.strip().splitlines()[-5:]
    raise UsageError("\n".join([f"the viewer {problem}; turn the view off to do without it. Its log ends:", *last]))


def spawn_anywhere(arguments: Sequence[str], logs: Path, **options: Any) -> tuple[subprocess.Popen[bytes], int]:
    """As `spawn`, at a free port, which is also returned; tries another one if a process takes it meanwhile."""

    def spawned(port: int) -> tuple[subprocess.Popen[bytes], int]:
        return spawn(port, ["--port", str(port), *arguments], logs, **options), port

    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(PortTaken):
            return spawned(free_port())
    return spawned(free_port())


def without_driver(log: str) -> str | None:
    """What to install, if a viewer's log says that it found nothing to draw with; None otherwise."""
    if "graphics adapter" not in log and "render context" not in log:
        return None
    return "no Vulkan driver to draw with; install one, on Debian: apt-get install mesa-vulkan-drivers"


def end(process: subprocess.Popen[bytes]) -> None:
    """Terminate a viewer, kill it if it does not end, wait for it, and remove the temporary folder that it leaves."""
    if process.poll() is None:
        process.terminate()
    kill(*wait_for([process], _STOP_SECONDS))
    # A viewer that draws makes this folder when it starts, and a terminated one does not remove it.
    for folder in Path(tempfile.gettempdir()).glob(f"rerun-data-{process.pid}-*"):
        shutil.rmtree(folder, ignore_errors=True)


def _give_up(process: subprocess.Popen[bytes]) -> None:
    end(process)
    if process.stdin is not None:
        process.stdin.close()


def executable() -> Path:
    """The file of Rerun's command. Raises UsageError if rerun-sdk is not installed."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise UsageError("the viewer is not installed; install rerun-sdk, or turn the view off")
    folder = Path(spec.origin).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return bundled if sys.platform == "darwin" and bundled.exists() else folder / "rerun"


def _listens(process: subprocess.Popen[bytes], port: int, meanwhile: Callable[[], None]) -> bool:
    """Whether the process listens on the port in time; false if it ends first. Raises PortTaken if another one listens there."""
    deadline, foreign = time.monotonic() + _START_SECONDS, 0
    # A process that is about to end owns nothing any more a moment before its port is closed, so a single probe proves nothing.
    while process.poll() is None and foreign < _FOREIGN_PROBES and time.monotonic() < deadline:
        listened_at = _is_listened_at(process, port)
        if listened_at and (is_apart(process) or owns(process.pid, port)):
            return True
        foreign = foreign + 1 if listened_at else 0
        meanwhile()
        time.sleep(0.02)
    if foreign == _FOREIGN_PROBES or (process.poll() is not None and _is_listened_at(process, port)):
        raise PortTaken(
            f"another process of this machine listens at {HOST}:{port}, where the viewer was to listen; nothing was shown to it. "
            "Try again, choose the web view, or turn the view off"
        )
    return False


def _is_listened_at(process: subprocess.Popen[bytes], port: int) -> bool:
    """Whether any process listens on the port in the network of this process."""
    if is_apart(process):
        return bool(_inodes(process.pid, port))
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((HOST, port)) == 0


def owns(pid: int, port: int) -> bool:
    """Whether a process of this user listens on a port of loopback; false, too, if the system does not say."""
    if sys.platform != "linux":
        return _lsof_says(pid, port)
    sockets = {f"socket:[{inode}]" for inode in _inodes(pid, port)}
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # closed meanwhile
                if os.readlink(descriptor) in sockets:
                    return True
    return False


def _inodes(pid: int, port: int) -> list[str]:
    """The inodes of the sockets that listen on a port of loopback in the network of a process; Linux only."""
    try:
        lines = Path(f"/proc/{pid}/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    except OSError:  # it has ended
        return []
    place = f"{int.from_bytes(socket.inet_aton(HOST), sys.byteorder):08X}:{port:04X}"
    return [words[9] for words in map(str.split, lines) if words[1] == place and words[3] == "0A"]


def _lsof_says(pid: int, port: int) -> bool:
    """What lsof says, which macOS has."""
    command = [_LSOF, "-nP", "-a", "-p", str(pid), f"-iTCP@{HOST}:{port}", "-sTCP:LISTEN", "-t"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_START_SECONDS)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.stdout.split() == [str(pid)]


def _log(logs: Path) -> IO[bytes]:
    """The log file, or an unnamed one if the folder of a finished run is read-only."""
    try:
        make_private(logs)
        return open(logs / "viewer.log", "a+b", opener=private_opener)
    except OSError:
        return tempfile.TemporaryFile()


_WINDOW = ("--hide-welcome-screen",)
_DARK = "theme=dark"
"""The page's theme, for which the colours of the panels are made, whatever the browser's theme is."""


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose(mode: str) -> str:
    """One of "native", "web", "notebook" and "off", from these or "auto": native with a screen, otherwise web.

    Raises UsageError for any other word, and for "native" without a screen.
    """
    if mode == "auto":
        return "native" if has_screen() else "web"
    if mode not in {"native", "web", NOTEBOOK, "off"}:
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
        followed.open_early()
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
        cls,
        mode: str,
        logs: Path,
        recording: Path,
        complete: bool = False,
        options: Sequence[str] = _WINDOW,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Viewer | None:
        """Start a viewer and wait until it is ready; None for "off". A window's output goes to viewer.log in the folder `logs`.

        mode: "native", "web", "notebook", "off", or "auto". recording: the file to show, from its beginning on and as it grows;
        it need not exist yet. complete: whether the file no longer grows. options: those that a window is started with.
        meanwhile: called while waiting for a window.

        Raises UsageError if it cannot be started.
        """
        mode = choose(mode)
        if mode == "off":
            return None
        from evedrop.show.view.serving import Followed, feed  # noqa: PLC0415 - only with a view

        followed = Followed(recording, complete)
        if mode in {"web", NOTEBOOK}:
            return cls._page(followed, HOST, HOST, 0, 0, framed=mode == NOTEBOOK)
        process, _ = spawn_anywhere(
            [*options, "-"], logs, stdin=subprocess.PIPE, apart=not _screen_is_remote(), meanwhile=meanwhile
        )
        assert process.stdin is not None  # noqa: S101 - it is a pipe
        feed(followed, process.stdin)
        return cls(followed, process)

    @classmethod
    def serve(cls, web_address: WebAddress, recording: Path, complete: bool = False) -> Viewer:
        """Start a viewer for browsers at a given address; otherwise as `start`.

        Raises UsageError if it cannot be started, for example because a port is taken.
        """
        from evedrop.show.view.serving import Followed  # noqa: PLC0415 - only with a view

        followed = Followed(recording, complete)
        host, seen, port = web_address.host, web_address.seen, web_address.port
        try:
            return cls._page(followed, host, seen, port, port + 1)
        except UsageError as error:
            raise UsageError(f"--serve {host}:{port}: {error}") from error

    @classmethod
    def _page(
        cls, followed: Followed, host: str, seen: str, port: int, data_port: int, *, framed: bool = False
    ) -> Viewer:
        """A page at a port of ours, and the recording at another; 0: any free one. framed: for a notebook, which saves it."""
        from evedrop.show.view.serving import RerunPage, Served, WebPage  # noqa: PLC0415 - only with a view

        rerun = RerunPage(executable())
        served = Served(followed, host, data_port, private=framed)
        try:
            page = WebPage(rerun, host, port, seen, served.server_port, framed)
        except BaseException:
            served.stop()
            raise
        data = quote(f"http://{seen}:{served.server_port}{served.path}", safe="")
        return cls(followed, None, [served, page], f"http://{seen}:{page.server_port}/?url={data}&{_DARK}")

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
