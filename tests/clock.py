"""A clock for tests, in which no real time passes."""

from __future__ import annotations

from queue import Empty
from typing import TypeVar

from evedrop.system.threads import Condition, Queue

T = TypeVar("T")


class TestClock:
    """Time passes only when a test, or what it tests, lets it pass."""

    __test__ = False

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        """The present time."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass at once."""
        self.now += seconds

    def next(self, queue: Queue[T], timeout: float | None) -> T:
        """The next item; if the queue is empty, the time limit passes at once."""
        if queue.empty():
            self.now += 0.0 if timeout is None else timeout
            raise Empty
        return queue.get()

    def wait(self, condition: Condition, timeout: float | None) -> None:
        """Let the time limit pass at once; without one, wait until the condition is notified."""
        if timeout is None:
            condition.wait()
        else:
            self.now += timeout
