"""The clock by which processes wait; tests pass another one, which does not let them wait."""

from __future__ import annotations

import threading
import time
from queue import SimpleQueue
from typing import Protocol, TypeVar, final

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
