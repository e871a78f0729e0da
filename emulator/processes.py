"""Waits for the ends of processes, always with a limit."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Collection
from typing import Protocol, TypeVar

KILLED_SECONDS = 2.0
"""How long to wait for a killed process: the system ends it at once, unless it hangs in the system itself, as on a dead disk."""


class KillableProcess(Protocol):
    """The part of `subprocess.Popen` that is used here."""

    def kill(self) -> None:
        """End it."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; returns its exit status. Raises subprocess.TimeoutExpired."""


P = TypeVar("P", bound=KillableProcess)


def kill(*processes: KillableProcess) -> None:
    """Kill processes, and wait until they have ended, for `KILLED_SECONDS` at most."""
    for process in processes:
        process.kill()
    wait_for(processes, KILLED_SECONDS)


def wait_for(processes: Collection[P], seconds: float) -> list[P]:
    """Wait until processes have ended, for `seconds` at most; returns those that still run."""
    deadline = time.monotonic() + seconds
    left = []
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            left.append(process)
    return left
