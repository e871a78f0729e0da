"""Waits for the ends of processes, always with a limit, and deals with suspended ones."""

from __future__ import annotations

import subprocess
from collections.abc import Collection
from typing import TypeVar, final

from evedrop.system.killable import KILLED_SECONDS, KillableProcess
from evedrop.system.world import world

SUSPENDED_SECONDS = 60.0
"""How long a process that others wait for may be suspended."""
_POLL_SECONDS = 1.0


P = TypeVar("P", bound=KillableProcess)


def kill(*processes: KillableProcess) -> None:
    """Kill processes, and wait until they have ended, for `KILLED_SECONDS` at most."""
    for process in processes:
        process.kill()
    wait_for(processes, KILLED_SECONDS)


def wait_for(processes: Collection[P], seconds: float) -> list[P]:
    """Wait until processes have ended, for `seconds` at most; returns those that still run."""
    deadline = world().monotonic() + seconds
    left = []
    for process in processes:
        try:
            process.wait(max(0.0, deadline - world().monotonic()))
        except subprocess.TimeoutExpired:
            left.append(process)
    return left


@final
class SuspensionWatch:
    """Finds processes that stay suspended. Only the time in which this process runs counts."""

    def __init__(self) -> None:
        self._looks: dict[int, int] = {}
        self._next = world().monotonic()

    def suspended_for_good(self, pids: Collection[int]) -> int | None:
        """The first of these processes that has been suspended for `SUSPENDED_SECONDS`; None without one.

        To be called often: it looks once a second.
        """
        if world().monotonic() < self._next:
            return None
        self._next = world().monotonic() + _POLL_SECONDS
        self._looks = {pid: self._looks.get(pid, 0) + 1 for pid in pids if world().is_suspended(pid)}
        return next((pid for pid, looks in self._looks.items() if looks * _POLL_SECONDS > SUSPENDED_SECONDS), None)
