"""Starts the process of a brief; tests pass a starter that starts none."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Protocol

from evedrop.names import RECORDER, RELAY, ROUTER
from evedrop.system.processes import kill, wait_for
from evedrop.system.signals import SHOW_STACKS, held_back

TELLING = frozenset({RECORDER, ROUTER, RELAY})
"""The roles whose processes send the launcher events on their standard output."""
GRACE_SECONDS = 3.0  # for all processes to leave
CONNECTION_LOST = 1000
"""The status of a process on another host if the connection with the host, or its fork server, ended; no process ends with it."""
FORK_SERVER_LOST = 1001
"""The status of a process whose fork server ended or stopped responding; no process ends with it."""
_STACKS_SECONDS = 0.3  # for a process that does not leave to write the stacks of its threads into its log


class StartedProcess(Protocol):
    """The part of `subprocess.Popen` that the launcher uses."""

    @property
    def pid(self) -> int:
        """Its process id."""

    @property
    def stdin(self) -> IO[bytes] | None:
        """The launcher's end of the pipe to its standard input."""

    @property
    def stdout(self) -> IO[bytes] | None:
        """The events of a recorder or a router; None for others, and for a process on another host."""

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; returns its exit status. Raises subprocess.TimeoutExpired."""

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""

    def terminate(self) -> None:
        """Ask it to end."""

    def kill(self) -> None:
        """End it."""


class ReportedProcess(ABC):
    """A process whose end another process reports; used like a `subprocess.Popen`."""

    stdin: IO[bytes] | None = None
    stdout: IO[bytes] | None = None

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._status: int | None = None
        self._lock, self._over = threading.Lock(), threading.Event()

    @abstractmethod
    def _close(self) -> None:
        """Close what refers to the process, which has ended."""

    @abstractmethod
    def send_signal(self, sig: int) -> None:
        """Send a signal to it, if it still runs."""

    def ended(self, status: int) -> None:
        """Note that it ended with this status; only the first report counts."""
        with self._lock:
            if self._status is not None:
                return
            self._close()
            self._status = status
        self._over.set()

    def poll(self) -> int | None:
        """Its status; None while it runs."""
        return self._status

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""
        if not self._over.wait(timeout) or self._status is None:
            raise subprocess.TimeoutExpired("evedrop", timeout or 0.0)
        return self._status

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)


class Starter(Protocol):
    """Starts the process of a role with the file of its brief; the events of `TELLING` roles come on `stdout`."""

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        """Start it. Raises OSError if the system cannot."""


def start_process(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
    """Start `evedrop ROLE BRIEF` in a session of its own."""
    with held_back():
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "evedrop", role, str(brief)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if role in TELLING else log,
            stderr=log,
            start_new_session=True,
            env=environment,
            umask=0o077,
        )


def end_all(processes: Collection[StartedProcess]) -> None:
    """Ask processes to end, and kill those that still run after `GRACE_SECONDS`. Returns within seconds in any case.

    A killed process whose end is never reported (its fork server or its host is suspended) ends with the connection to it.
    """
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)  # a paused process could not end
        if process.poll() is None:
            process.terminate()
    if hanging := wait_for(processes, GRACE_SECONDS):
        for process in hanging:
            process.send_signal(SHOW_STACKS)
        kill(*wait_for(hanging, _STACKS_SECONDS))
    for process in processes:
        if process.stdin is not None:
            process.stdin.close()
