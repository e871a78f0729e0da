"""The part of `subprocess.Popen` with which any process is ended."""

from __future__ import annotations

from typing import Protocol

KILLED_SECONDS = 10.0
"""How long to wait for a killed process: the next turn of a busy processor ends it, unless it hangs in the system itself."""


class KillableProcess(Protocol):
    """A process that can be ended."""

    def kill(self) -> None:
        """End it."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; returns its exit status. Raises subprocess.TimeoutExpired."""
