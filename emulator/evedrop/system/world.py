"""The world in which a program runs: time, threads, locks and queues, this process, the disk, and Zenoh.

`world()` is the real one, unless a test has put the program into a simulated one (`evedrop.virtual`), where all programs of a run
live in one interpreter, time is virtual, and a seed decides which of them goes on next. A program does not know which it is.

So `threading`, `queue`, `time`, `signal` and the ends of processes are used here and in the other modules of this package only.
"""

from __future__ import annotations

import os
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import IO, TYPE_CHECKING, Any, Protocol, final

from evedrop.system.disk import REAL_DISK, Disk
from evedrop.system.this_process import REAL_PROCESS, ThisProcess
from evedrop.system.threads import Condition, Lock, Queue, Thread, ThreadEvent

if TYPE_CHECKING:
    import ssl

    from evedrop.system.fork_channels import ForkChannel
    from evedrop.system.ssh_client import SshClient

Address = tuple[str, int] | Path
"""Host and port, or the path of a Unix socket."""


class World(Protocol):
    """What a program needs of the machine that it runs on."""

    def monotonic(self) -> float:
        """Seconds since some moment."""

    def time(self) -> float:
        """Seconds since 1970, by the machine's clock."""

    def sleep(self, seconds: float) -> None:
        """Let time pass."""

    def thread(self, work: Callable[..., object], *arguments: object, name: str, daemon: bool = True) -> Thread:
        """A thread, not started yet."""

    def lock(self) -> Lock:
        """A lock."""

    def rlock(self) -> Lock:
        """A lock that the thread that holds it can take again."""

    def condition(self) -> Condition:
        """A condition with a lock of its own."""

    def event(self) -> ThreadEvent:
        """An event."""

    def queue(self) -> Queue[Any]:
        """A queue without a limit."""

    def token(self, size: int) -> bytes:
        """Bytes that nobody can guess."""

    def dial(self, address: Address, seconds: float) -> socket.socket:
        """Connect to the program that listens at an address, within this time. Raises OSError."""

    def certificate(self, link: socket.socket, trust: ssl.SSLContext, host: str) -> bytes:
        """The certificate, as DER, that a host shows on a connection, which is of no use afterwards.

        Raises SSLCertVerificationError if it is not to be trusted, and any other OSError.
        """

    def expect_free(self, host: str, port: int) -> None:
        """Raise OSError unless this machine can listen at this port."""

    def pipe(self) -> tuple[IO[bytes], IO[bytes]]:
        """The two ends of a pipe, which other processes can inherit: to read from, and to write to. Raises OSError."""

    @property
    def forks(self) -> bool:
        """Whether there can be fork servers: not outside Linux, or where a sandbox forbids them."""

    def fork_channels(self, modules: Sequence[Sequence[str]]) -> AbstractContextManager[Sequence[ForkChannel]]:
        """Channels with fork servers, each of which imports these modules and those of the servers before it. Raises OSError."""

    def ssh(self, command: Sequence[str]) -> SshClient:
        """Start ssh with a command. Raises OSError."""

    def temporary_folder(self) -> Path:
        """Where temporary files are made. Raises OSError if there is no such folder."""

    def is_suspended(self, pid: int) -> bool:
        """Whether a process is suspended, as by SIGSTOP; False where the system does not say."""

    @property
    def process(self) -> ThisProcess:
        """The process that asks."""

    @property
    def disk(self) -> Disk:
        """The disks of the machine."""

    @property
    def zenoh(self) -> Any:
        """The module `zenoh`, or what stands for it."""


@final
class RealWorld(World):
    """The machine."""

    # The functions themselves: a wire asks for the time three times for each message.
    monotonic, time = staticmethod(time.monotonic), staticmethod(time.time)
    lock = staticmethod(threading.Lock)
    rlock = staticmethod(threading.RLock)
    condition = staticmethod(threading.Condition)
    event = staticmethod(threading.Event)
    queue: Callable[[], Queue[Any]] = staticmethod(SimpleQueue)
    process = REAL_PROCESS
    disk = REAL_DISK

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def thread(self, work: Callable[..., object], *arguments: object, name: str, daemon: bool = True) -> Thread:
        """A thread of the system."""
        return threading.Thread(target=work, args=arguments, name=name, daemon=daemon)

    def token(self, size: int) -> bytes:
        """Bytes that nobody can guess."""
        return secrets.token_bytes(size)

    def dial(self, address: Address, seconds: float) -> socket.socket:
        """Connect to the program that listens there."""
        if isinstance(address, tuple):
            return socket.create_connection(address, seconds)
        link = socket.socket(socket.AF_UNIX)
        try:
            link.settimeout(seconds)
            link.connect(str(address))
        except BaseException:
            link.close()
            raise
        return link

    def certificate(self, link: socket.socket, trust: ssl.SSLContext, host: str) -> bytes:
        """The certificate that the host shows."""
        with trust.wrap_socket(link, server_hostname=host) as shown:
            return shown.getpeercert(binary_form=True) or b""

    def expect_free(self, host: str, port: int) -> None:
        """Raise OSError unless this machine can listen there."""
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = addresses[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)

    def pipe(self) -> tuple[IO[bytes], IO[bytes]]:
        """A pipe of the system."""
        read, write = os.pipe()
        return os.fdopen(read, "rb", buffering=0), os.fdopen(write, "wb")

    @property
    def forks(self) -> bool:
        """Whether the system can refer to processes."""
        try:
            os.close(os.pidfd_open(os.getpid()))
        except (AttributeError, OSError):
            return False
        return True

    def fork_channels(self, modules: Sequence[Sequence[str]]) -> AbstractContextManager[Sequence[ForkChannel]]:
        """Channels with processes of the system."""
        from evedrop.system.fork_channels import fork_channels  # noqa: PLC0415 - most commands start no process

        return fork_channels(modules)

    def ssh(self, command: Sequence[str]) -> SshClient:
        """The system's ssh."""
        from evedrop.system.ssh_client import SystemSsh  # noqa: PLC0415 - not needed on one machine

        return SystemSsh(command)

    def temporary_folder(self) -> Path:
        """That of the environment."""
        return Path(tempfile.gettempdir())

    def is_suspended(self, pid: int) -> bool:
        """Whether it is suspended, by Linux."""
        try:
            return Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[:1] == ["T"]
        except OSError:
            return False

    @property
    def zenoh(self) -> Any:
        """Zenoh itself, which the launcher does not import."""
        import zenoh  # noqa: PLC0415

        return zenoh


_world: World = RealWorld()


def world() -> World:
    """The world that this program is in."""
    return _world


@contextmanager
def inside(other: World) -> Iterator[None]:
    """Let all programs of this interpreter be in another world while the block runs."""
    global _world  # noqa: PLW0603 - this is its purpose
    before, _world = _world, other
    try:
        yield
    finally:
        _world = before
