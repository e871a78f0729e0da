"""An sshd of our own on loopback, with keys and configuration of its own; it uses no file of the user or the machine."""

from __future__ import annotations

import fcntl
import getpass
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from evedrop.system.ports import free_port
from tests.conftest import wait_until
from tests.privileged import CannotRun, run

_SEPARATION = Path("/run/sshd")
_SERVER = """
Port {port}
ListenAddress {address}
HostKey {folder}/host
AuthorizedKeysFile {folder}/user.pub
PidFile none
StrictModes no
PasswordAuthentication no
KbdInteractiveAuthentication no
UsePAM no
MaxStartups 3
"""
_CLIENT = """
Host *
  Port {port}
  IdentityFile {folder}/user
  IdentitiesOnly yes
  UserKnownHostsFile {folder}/known_hosts
  GlobalKnownHostsFile /dev/null
  StrictHostKeyChecking yes
"""


@dataclass(frozen=True)
class Sshd:
    """A running server, and what a client needs."""

    folder: Path
    process: subprocess.Popen[bytes]
    address: str
    port: int

    @property
    def config(self) -> Path:
        """The configuration of a client."""
        return self.folder / "client"

    def sessions(self) -> list[int]:
        """The processes that each serve a connection."""
        return descendants(self.process.pid)


def descendants(pid: int) -> list[int]:
    """The ids of the children of a process, and of theirs; parents first."""
    pids = []
    with suppress(OSError):
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            pids += [int(child), *descendants(int(child))]
    return pids


def program() -> str:
    """The path of sshd. Raises CannotRun."""
    path = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
    if path is None or shutil.which("ssh") is None or shutil.which("ssh-keygen") is None:
        raise CannotRun("sshd or ssh is not installed (Debian's openssh-server)")
    return path


@contextmanager
def _separated() -> Iterator[None]:
    """Make the folder in which sshd confines its children as root; remove it later, unless it was there or a test uses it."""
    if os.getuid() != 0:
        yield
        return
    made = False
    with suppress(FileExistsError):
        _SEPARATION.mkdir(0o755)
        made = True
    folder = os.open(_SEPARATION, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_SH)
        yield
    finally:
        if made:
            with suppress(OSError):
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _SEPARATION.rmdir()
        os.close(folder)


@contextmanager
def sshd(folder: Path, address: str = "127.0.0.1", enter: tuple[str, ...] = (), port: int = 0) -> Iterator[Sshd]:
    """A server that lets this user in, until the block ends.

    enter: the words that start a command on its host. Raises CannotRun if there is no sshd, or it does not start.
    """
    command = program()
    port = port or free_port()
    with _separated():
        for name in ("host", "user"):
            run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", getpass.getuser(), "-f", str(folder / name))
        key = " ".join((folder / "host.pub").read_text().split()[:2])
        name = address if port == 22 else f"[{address}]:{port}"
        (folder / "known_hosts").write_text(f"{name} {key}\n")
        given = {"port": port, "folder": folder, "address": address}
        (folder / "server").write_text(_SERVER.format(**given))
        (folder / "client").write_text(_CLIENT.format(**given))
        with (folder / "sshd.log").open("wb") as log:
            process = subprocess.Popen(
                [*enter, command, "-D", "-e", "-f", str(folder / "server")],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        server = Sshd(folder, process, address, port)
        try:
            log_file = folder / "sshd.log"
            wait_until(
                lambda: b"listening" in log_file.read_bytes() or process.poll() is not None, "an sshd that listens"
            )
            if process.poll() is not None:
                raise CannotRun(f"sshd does not start: {log_file.read_text().strip()[-500:]}")
            yield server
        finally:
            for pid in (process.pid, *server.sessions()):
                with suppress(ProcessLookupError):
                    os.kill(pid, 9)
            process.wait()
