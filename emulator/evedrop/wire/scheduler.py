"""Holds messages back until their delay is over, and passes them on in the order of their times.

Source: docs/wire.md, how messages cross.
"""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable
from typing import NamedTuple, final

from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.system.threads import wait_for_thread
from evedrop.wire.watchdog import Duty


class _Held(NamedTuple):
    due: float
    serial: int
    size: int
    row: int
    send: Callable[[], object]


@final
class KeyOrder:
    """Messages of which none is sent before an earlier one, such as those of a key."""

    __slots__ = ("_latest", "due")

    def __init__(self) -> None:
        self.due = 0.0
        """When the latest decided message is due, in seconds of the monotonic clock."""
        self._latest = 0.0

    def delay(self, delay: float, now: float) -> float:
        """The delay, in seconds, of the next message, which by itself has another one."""
        self.due = max(self.due, now + delay)
        return self.due - now

    def send_at(self, due: float) -> float:
        """When a message is sent that is due at a time: not before the one that was held before."""
        self._latest = max(self._latest, due)
        return self._latest


@final
class Scheduler:
    """A thread that carries out tasks when they are due. It holds a limited number of messages, and of bytes."""

    def __init__(self, most: int, most_bytes: int, failed: Callable[[int], None], clock: Clock = SYSTEM_CLOCK) -> None:
        """most, most_bytes: how much it may hold; failed: is given the row of a message that raised an error."""
        self._clock = clock
        self._most, self._most_bytes, self._failed = most, most_bytes, failed
        self._heap: list[_Held] = []
        self._bytes = 0
        self._serial = itertools.count()
        self._changed = threading.Condition()
        self._ended = False
        self.duty = Duty("among the delayed messages")
        self._thread = threading.Thread(target=self._run, name="delays", daemon=True)
        self._thread.start()

    def hold(
        self, delay: float, size: int, row: int, send: Callable[[], object], order: KeyOrder | None = None
    ) -> bool:
        """Send a message of some bytes after some seconds, or later to keep an order; returns whether there is room for it.

        row: its row in the journal.
        """
        with self._changed:
            if self._ended or len(self._heap) >= self._most or self._bytes + size > self._most_bytes:
                return False
            due = self._clock.monotonic() + delay
            held = _Held(due if order is None else order.send_at(due), next(self._serial), size, row, send)
            heapq.heappush(self._heap, held)
            self._bytes += size
            if self._heap[0] is held:
                self._changed.notify()
        return True

    @property
    def held(self) -> int:
        """How many messages wait."""
        return len(self._heap)

    def close(self) -> list[int]:
        """End the thread. Returns the rows of the messages that were not sent."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        wait_for_thread(self._thread)
        left, self._heap = [held.row for held in sorted(self._heap)], []
        return left

    def _run(self) -> None:
        while True:
            with self._changed:
                held = self._due()
            if held is None:
                return
            self.duty.in_hand = held
            try:
                held.send()
            except Exception:
                self._failed(held.row)
            self.duty.in_hand = None

    def _due(self) -> _Held | None:
        """The next message, when it is due; None at the end. The lock is held."""
        while not self._ended:
            if not self._heap:
                self._clock.wait(self._changed, None)
                continue
            wait = self._heap[0].due - self._clock.monotonic()
            if wait <= 0:
                held = heapq.heappop(self._heap)
                self._bytes -= held.size
                return held
            self._clock.wait(self._changed, wait)
        return None
