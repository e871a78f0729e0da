"""The simulated world, as the programs in it see it: `VirtualWorld` stands for the machine wherever they ask `world()`.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import socket
import ssl
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import IO, Any, cast, final

from evedrop.system.disk import Disk
from evedrop.system.fork_channels import ForkChannel
from evedrop.system.ssh_client import SshClient
from evedrop.system.this_process import ThisProcess
from evedrop.system.threads import Condition, Lock, Queue, Thread, ThreadEvent
from evedrop.system.world import Address, World
from evedrop.virtual.disk import VirtualDisk
from evedrop.virtual.host_parts import HOST_FORK_SERVER, part_on
from evedrop.virtual.notes import BY_HAND
from evedrop.virtual.pipes import Pipe, PipeFile
from evedrop.virtual.processes import FORK_SERVERS, LAUNCHER, VirtualForkServer, VirtualMachine
from evedrop.virtual.scheduler import (
    VirtualCondition,
    VirtualEvent,
    VirtualLock,
    VirtualQueue,
    VirtualScheduler,
)

TEMPORARY = "temporary"
"""The folder for temporary files on the disk of another host."""
EPOCH = 1_767_225_600.0
"""The virtual clock of every machine at the beginning: 2026-01-01."""


@final
class VirtualWorld(World):
    """A world whose scheduler decides who goes on, and whose time is virtual."""

    def __init__(self, scheduler: VirtualScheduler, machine: VirtualMachine, zenoh: Any, disk: Disk) -> None:
        self.scheduler, self.machine, self._disk = scheduler, machine, disk
        self._zenoh = zenoh
        self.client: Callable[[Sequence[str]], SshClient] | None = None
        """Starts ssh, if there are other hosts."""
        self.temporary: Path | None = None
        """In place of the temporary folder of the environment, where another world may make the same names."""
        self.disks: dict[str, VirtualDisk] = {}
        """Other host → its disk."""

    def monotonic(self) -> float:
        """Virtual seconds."""
        return self.scheduler.now

    def time(self) -> float:
        """Virtual seconds since 1970, by the clock of the current process."""
        thread = self.scheduler.current
        return EPOCH + self.scheduler.now + (0.0 if thread is None else thread.task.clock)

    def is_suspended(self, pid: int) -> bool:
        """Whether it is."""
        return any(task.stopped for task in self.scheduler.tasks if task.number == pid)

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.scheduler.sleep(seconds)

    def thread(self, work: Callable[..., object], *arguments: object, name: str, daemon: bool = True) -> Thread:
        """A thread of the current process."""
        del daemon
        return self.scheduler.thread(name, lambda: work(*arguments), admit=self.machine.admit_thread)

    def lock(self) -> Lock:
        """A lock."""
        return VirtualLock(self.scheduler)

    def rlock(self) -> Lock:
        """A lock that its holder can take again."""
        return VirtualLock(self.scheduler, again=True)

    def condition(self) -> Condition:
        """A condition."""
        return VirtualCondition(self.scheduler)

    def event(self) -> ThreadEvent:
        """An event."""
        return VirtualEvent(self.scheduler)

    def queue(self) -> Queue[Any]:
        """A queue."""
        return VirtualQueue(self.scheduler)

    def token(self, size: int) -> bytes:
        """Bytes that the seed decides."""
        return self.scheduler.random.randbytes(size)

    def dial(self, address: Address, seconds: float) -> socket.socket:
        """Connect to the router that listens there."""
        del seconds
        return cast("socket.socket", self._zenoh.dial(address))

    def certificate(self, link: socket.socket, trust: ssl.SSLContext, host: str) -> bytes:
        """The certificate of the router at the other end."""
        shown: bytes = cast(Any, link).certificate(trust, host, self.time())
        return shown

    def expect_free(self, host: str, port: int) -> None:
        """Raise OSError if a router listens there."""
        self._zenoh.expect_free((host, port))

    def pipe(self) -> tuple[IO[bytes], IO[bytes]]:
        """A pipe between simulated processes."""
        pipe = Pipe(self.scheduler)
        return cast("IO[bytes]", PipeFile(pipe)), cast("IO[bytes]", pipe.end())

    @property
    def forks(self) -> bool:
        """There always can."""
        return True

    def fork_channels(self, modules: Sequence[Sequence[str]]) -> AbstractContextManager[Sequence[ForkChannel]]:
        """Channels with simulated fork servers on the machine of the current process."""
        task = self.machine.current.task
        names = [part_on(HOST_FORK_SERVER, task.host)] if task.host else FORK_SERVERS
        others = "" if task.host or task.name == LAUNCHER else f" {BY_HAND}"  # no fault of the run hits them
        return nullcontext([VirtualForkServer(self.machine, f"{name}{others}") for name in names[: len(modules)]])

    def ssh(self, command: Sequence[str]) -> SshClient:
        """A simulated ssh, which the other hosts have."""
        assert self.client is not None  # noqa: S101 - only a run with other hosts asks
        return self.client(command)

    def temporary_folder(self) -> Path:
        """That of the machine of the current process."""
        disk = self._other_disk
        return self.temporary or Path(tempfile.gettempdir()) if disk is None else disk.root / TEMPORARY

    @property
    def process(self) -> ThisProcess:
        """The process of the current thread."""
        return self.machine.current

    @property
    def disk(self) -> Disk:
        """The disk, simulated or not, of the machine of the current process."""
        return self._other_disk or self._disk

    @property
    def _other_disk(self) -> VirtualDisk | None:
        thread = self.scheduler.current
        return None if thread is None else self.disks.get(thread.task.host)

    @property
    def zenoh(self) -> Any:
        """The simulated Zenoh."""
        return self._zenoh
