"""Channels with fork servers: bare processes that have imported modules, and start others with them (`evedrop.fork_server`).

Source: docs/architecture.md, why it is built this way.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, Protocol, final

from evedrop.system.environment import SINGLE_THREADED, own_environment
from evedrop.system.killable import KILLED_SECONDS, KillableProcess
from evedrop.system.signals import held_back

POLL_SECONDS = 0.25
"""For how long a channel waits for a report."""
_MOST_BYTES = 4096


class ProcessHandle(Protocol):
    """Refers to a process: once it has ended, its id may be another process's."""

    @property
    def over(self) -> bool:
        """Whether the process has ended."""

    def send_signal(self, sig: int) -> None:
        """Send a signal to it. Raises ProcessLookupError if it has ended."""

    def close(self) -> None:
        """Refer to it no longer."""


class StandardFiles(Protocol):
    """The standard files of a process that is forked."""

    descriptors: tuple[int, int, int]
    """Of standard input, standard output and standard error."""
    stdin: IO[bytes]
    """The launcher's end of standard input."""
    stdout: IO[bytes] | None
    """The launcher's end of standard output, if the launcher reads it."""

    def close_theirs(self) -> None:
        """Close the ends of the process, which has its own."""


class ForkChannel(Protocol):
    """The launcher's end of its channel with a fork server."""

    def files(self, log: IO[bytes], tells: bool) -> StandardFiles:
        """Files for a process; tells: whether the launcher reads its standard output."""

    def send(self, request: bytes, descriptors: tuple[int, int, int]) -> None:
        """Send a request, with the standard files of the process. Raises OSError."""

    def receive(self) -> tuple[bytes, list[ProcessHandle]]:
        """The next report, with a process that it is about; empty at the end. Raises TimeoutError after a moment, OSError."""

    def shut(self) -> None:
        """End it for both sides. Raises OSError if it is closed."""

    def close(self) -> None:
        """Close this end."""


@final
class _Descriptor:
    """A file descriptor that refers to a process."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @property
    def over(self) -> bool:
        """Whether the process has ended: the system says so."""
        system = select.poll()
        system.register(self._descriptor, select.POLLIN)
        return bool(system.poll(0))

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""
        signal.pidfd_send_signal(self._descriptor, sig)

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self._descriptor)


@final
class _Pipes:
    """A pipe to a process, its log, and perhaps a pipe from it."""

    def __init__(self, log: IO[bytes], tells: bool) -> None:
        read_stdin, write_stdin = os.pipe()
        self._write_stdout: int | None
        read_stdout, self._write_stdout = os.pipe() if tells else (None, None)
        self._read_stdin = read_stdin
        self.stdin: IO[bytes] = os.fdopen(write_stdin, "wb")
        self.stdout: IO[bytes] | None = None if read_stdout is None else os.fdopen(read_stdout, "rb")
        stdout = log.fileno() if self._write_stdout is None else self._write_stdout
        self.descriptors = (read_stdin, stdout, log.fileno())

    def close_theirs(self) -> None:
        """Close the ends of the process."""
        os.close(self._read_stdin)
        if self._write_stdout is not None:
            os.close(self._write_stdout)


@final
class _Socket:
    """A channel over a socket that passes file descriptors on."""

    def __init__(self, ours: socket.socket) -> None:
        ours.settimeout(POLL_SECONDS)
        self._ours = ours

    def files(self, log: IO[bytes], tells: bool) -> StandardFiles:
        """Pipes of the system."""
        return _Pipes(log, tells)

    def send(self, request: bytes, descriptors: tuple[int, int, int]) -> None:
        """Send a request, with descriptors."""
        socket.send_fds(self._ours, [request], descriptors)

    def receive(self) -> tuple[bytes, list[ProcessHandle]]:
        """The next report."""
        report, handles, _, _ = socket.recv_fds(self._ours, _MOST_BYTES, 1)
        return report, [_Descriptor(handle) for handle in handles]

    def shut(self) -> None:
        """End it for both sides."""
        self._ours.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close this end."""
        self._ours.close()


def start_servers(channels: Sequence[socket.socket], modules: Sequence[Sequence[str]]) -> KillableProcess:
    """Start the first of some fork servers, each of which takes requests from its end of a channel. Raises OSError.

    modules: what each imports in addition to those before it. Each server after the first is forked from the one before.
    """
    words = [[str(channel.fileno()), *names] for channel, names in zip(channels, modules, strict=True)]
    with held_back():
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "evedrop.fork_server", json.dumps(words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={**own_environment(), **SINGLE_THREADED},
            pass_fds=[channel.fileno() for channel in channels],
        )


def _end(process: KillableProcess) -> None:
    process.kill()
    with suppress(subprocess.TimeoutExpired):
        process.wait(KILLED_SECONDS)


@contextmanager
def fork_channels(modules: Sequence[Sequence[str]]) -> Iterator[Sequence[ForkChannel]]:
    """Channels with fork servers, as of `start_servers`, which are killed at the end of the block. Raises OSError."""
    with ExitStack() as stack:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in modules]
        for ours, _ in pairs:  # also if no process, or no thread, can be started
            stack.callback(ours.close)
        with ExitStack() as theirs:
            for _, end in pairs:
                theirs.enter_context(end)
            process = start_servers([end for _, end in pairs], modules)
        stack.callback(_end, process)  # it may be in the middle of its imports, or suspended
        yield [_Socket(ours) for ours, _ in pairs]
