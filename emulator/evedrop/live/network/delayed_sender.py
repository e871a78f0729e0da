"""Deliveries delayed by a fraction of a slot in real time: sent when they are due, in order, while the router continues.

Delays of whole slots are emulated time, the same in every run; this module only decides when a message is really sent.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import final

Put = Callable[[bytes], None]


@final
class DelayedSender:
    """Sends messages when they are due, on a daemon thread of its own: a run ends only when all have arrived."""

    def __init__(self) -> None:
        self._due: list[tuple[float, int, Put, bytes]] = []
        self._numbers = itertools.count()
        self._changed = threading.Condition()
        threading.Thread(target=self._go_round, name="delayed-sender", daemon=True).start()

    def round(self, put: Put) -> Callable[[bytes, float], None]:
        """A publisher that sends each message the given seconds later, but never before the previous message."""
        last = 0.0

        def send(payload: bytes, seconds: float) -> None:
            nonlocal last
            last = max(last, time.monotonic() + seconds)
            with self._changed:
                heapq.heappush(self._due, (last, next(self._numbers), put, payload))
                self._changed.notify()

        return send

    def _go_round(self) -> None:
        while True:
            with self._changed:
                while not self._due or (wait := self._due[0][0] - time.monotonic()) > 0.0:
                    self._changed.wait(wait if self._due else None)
                _, _, put, payload = heapq.heappop(self._due)
            put(payload)
