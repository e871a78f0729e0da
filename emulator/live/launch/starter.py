"""Starts the process of a brief; tests pass a starter that starts none."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Protocol

from evedrop.names import OBSERVER


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
        """An observer's news; None for others."""

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


class Starter(Protocol):
    """Starts the process of a role with the file of its brief; an observer's news come on `stdout`."""

    def __call__(self, role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
        """Start it. Raises OSError if the system cannot."""


def start_process(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
    """Start `evedrop ROLE BRIEF` in a session of its own."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "evedrop", role, str(brief)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE if role == OBSERVER else log,
        stderr=log,
        start_new_session=True,
        env=environment,
        umask=0o077,
    )
