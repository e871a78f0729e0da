"""Starts and ends Rerun's viewer as a child process. Neither Rerun nor Zenoh is imported here.

Rerun's own functions start viewers that listen on every interface; with its command, the interface can be chosen. A viewer whose
port another process has taken sends that process all it is given to show. So we give it nothing before it is known that the
viewer itself listens.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from evedrop.errors import UsageError
from evedrop.results.folder import make_private, private_opener
from evedrop.system.environment import viewer_environment
from evedrop.system.processes import kill, signalled_when_parent_dies, wait_for

HOST = "127.0.0.1"
_LSOF = "/usr/sbin/lsof"
_START_SECONDS = 120.0
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
) -> subprocess.Popen[bytes]:
    """Start Rerun's command with these arguments, only on loopback; returns when it listens on `port`.

    arguments: must not name what is to be shown, for another process may have taken the port. apart: with a network of its own,
    if the system allows it.

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
            if _listens(process, port):
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


def _listens(process: subprocess.Popen[bytes], port: int) -> bool:
    """Whether the process listens on the port in time; false if it ends first. Raises PortTaken if another one listens there."""
    deadline, foreign = time.monotonic() + _START_SECONDS, 0
    # A process that is about to end owns nothing any more a moment before its port is closed, so a single probe proves nothing.
    while process.poll() is None and foreign < _FOREIGN_PROBES and time.monotonic() < deadline:
        listened_at = _is_listened_at(process, port)
        if listened_at and (is_apart(process) or owns(process.pid, port)):
            return True
        foreign = foreign + 1 if listened_at else 0
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
