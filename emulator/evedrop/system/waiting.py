"""Waits, always with a limit: for the ends of threads, and by a clock.

Tests of a wire pass another clock, which does not let them wait.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, final

from evedrop.errors import RunError
from evedrop.system.threads import Condition, Thread, ThreadEvent
from evedrop.system.world import world

THREAD_SECONDS = 600.0
"""How long to wait for a thread that was told to end. It ends within seconds, unless something that it calls hangs."""


def wait_for_thread(thread: Thread, seconds: float = THREAD_SECONDS) -> None:
    """Wait until a thread has ended. Raises RunError if it still runs after `seconds`."""
    if thread.ident is None:  # it was never started, as on a machine that lacks threads: the reason is told elsewhere
        return
    thread.join(seconds)
    if thread.is_alive():
        raise RunError(
            f"the thread {thread.name} was told to end {seconds:g} s ago and still runs, because something that it called has "
            "hung; report this"
        )


def wait_until(holds: Callable[[], bool], seconds: float, step: float) -> bool:
    """Look every `step` seconds whether something holds, for `seconds` at most; returns whether it does."""
    deadline = world().monotonic() + seconds
    while not (held := holds()) and world().monotonic() < deadline:
        world().sleep(step)
    return held


@final
class Alarm:
    """Does something once some time has passed, on a thread of its own, unless it is set again or put off before.

    Time in which the process was suspended hardly counts: it waits in steps.
    """

    def __init__(self, act: Callable[[], object]) -> None:
        self._act, self._off = act, world().event()
        self._lock = world().lock()

    def set(self, seconds: float | None) -> None:
        """Do it after `seconds`; None: do not do it."""
        with self._lock:
            self._off.set()
            if seconds is not None:
                self._off = world().event()
                world().thread(self._wait, self._off, seconds, name="alarm").start()

    def _wait(self, off: ThreadEvent, seconds: float) -> None:
        step, left = max(1.0, seconds / 8.0), seconds
        while left > 0.0:
            if off.wait(min(step, left)):
                return
            left -= step
        self._act()


class Clock(Protocol):
    """Measures time, and lets it pass."""

    def monotonic(self) -> float:
        """Seconds since some moment."""

    def wait(self, condition: Condition, timeout: float | None) -> None:
        """Wait until a condition is notified, or for `timeout` seconds; None: waits as long as it takes."""


@final
class SystemClock:
    """The clock of the machine."""

    def monotonic(self) -> float:
        """Seconds since some moment."""
        return world().monotonic()

    def wait(self, condition: Condition, timeout: float | None) -> None:
        """Wait until a condition is notified, or for some seconds."""
        condition.wait(timeout)


SYSTEM_CLOCK: Clock = SystemClock()


@final
class SteadyClock:
    """Seconds since 1970 by a clock that goes on evenly when the system's clock is set."""

    def __init__(self) -> None:
        """Agree with the system's clock now."""
        self.ahead = world().time() - world().monotonic()
        """What it adds to the monotonic clock."""

    def time(self) -> float:
        """The time now."""
        return self.ahead + world().monotonic()
