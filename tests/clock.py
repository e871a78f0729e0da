"""A clock for tests, in which no real time passes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Any, cast

from evedrop.system.threads import Condition, Queue
from evedrop.system.world import RealWorld, inside, world


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

    def wait(self, condition: Condition, timeout: float | None) -> None:
        """Let the time limit pass at once; without one, wait until the condition is notified."""
        if timeout is None:
            condition.wait()
        else:
            self.now += timeout


class TestQueue(SimpleQueue[Any]):
    """A queue at which the time limit passes at once if it is empty."""

    def __init__(self, clock: TestClock) -> None:
        self._clock = clock

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """The next item."""
        if timeout is not None and self.empty():
            self._clock.sleep(timeout)
            raise Empty
        return super().get(block, timeout)


class TestWorld(RealWorld):  # type: ignore[misc]  # which is final for programs
    """The machine with the time of a test."""

    __test__ = False

    def __init__(self) -> None:
        self.clock = TestClock()

    def monotonic(self) -> float:
        """The present time."""
        return self.clock.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let time pass at once."""
        self.clock.sleep(seconds)

    def queue(self) -> Queue[Any]:
        """A queue without a limit."""
        return TestQueue(self.clock)


@contextmanager
def time_of_a_test() -> Iterator[TestClock]:
    """Programs in the block go by this clock."""
    tested = TestWorld()
    with inside(tested):
        yield tested.clock


def clock_at_start() -> TestClock:
    """The clock of the world, in a `time_of_a_test`, set back."""
    clock = cast(TestWorld, world()).clock
    clock.now = 1000.0
    return clock
