"""Waits, always with a limit: for the ends of threads, and by a clock.

Tests pass another clock, which does not let them wait.
"""

from __future__ import annotations

import threading
import time
from queue import SimpleQueue
from typing import Protocol, TypeVar, final

from evedrop.errors import RunError

THREAD_SECONDS = 600.0
"""How long to wait for a thread that was told to end. It ends within seconds, unless something that it calls hangs."""


def wait_for_thread(thread: threading.Thread, seconds: float = THREAD_SECONDS) -> None:
    """Wait until a thread has ended. Raises RunError if it still runs after `seconds`."""
    if thread.ident is None:  # it was never started, as on a machine that lacks threads: the reason is told elsewhere
        return
    thread.join(seconds)
    if thread.is_alive():
        raise RunError(
            f"the thread {thread.name} was told to end {seconds:g} s ago and still runs, because something that it called has "
            "hung; report this"
        )


T = TypeVar("T")


class Clock(Protocol):
    """Measures time, and lets it pass."""

    def monotonic(self) -> float:
        """Seconds since some moment."""

    def sleep(self, seconds: float) -> None:
        """Let time pass."""

    def next(self, queue: SimpleQueue[T], timeout: float | None) -> T:
        """Wait for the next item of a queue. Raises Empty after `timeout` seconds; None: waits as long as it takes."""

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """Wait until a condition is notified, or for `timeout` seconds; None: waits as long as it takes."""


@final
class SystemClock:
    """The clock of the machine."""

    def monotonic(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def next(self, queue: SimpleQueue[T], timeout: float | None) -> T:
        """Wait for the next item of a queue. Raises Empty."""
        return queue.get(timeout=timeout)

    def wait(self, condition: threading.Condition, timeout: float | None) -> None:
        """Wait until a condition is notified, or for some seconds."""
        condition.wait(timeout)


SYSTEM_CLOCK: Clock = SystemClock()
