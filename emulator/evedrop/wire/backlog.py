"""Takes messages from a channel of Zenoh, and says how many of them wait in it.

Zenoh does not tell how full a channel is. So the messages are counted when somebody asks: those that are taken from then on until
the channel is empty. Messages that come meanwhile count, too.

Source: docs/wire.md, what Zenoh drops by itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, final

import zenoh

from evedrop.wire.watchdog import Duty


@final
class _Count:
    """A count that has begun."""

    __slots__ = ("answer", "taken")

    def __init__(self, answer: Callable[[int], None]) -> None:
        self.answer = answer
        self.taken = 0


@final
class Backlog:
    """The messages that a thread has not taken yet. `ask` may be called by any thread."""

    def __init__(self, handler: Any, most: int) -> None:
        """handler: of a subscriber with a channel; most: the messages that the channel has room for."""
        self._handler, self._most = handler, most
        self._counts: list[_Count] = []
        self._is_empty = False
        self._lock = threading.Lock()

    def ask(self, answer: Callable[[int], None]) -> None:
        """Let `answer` have the number of messages that wait now: at once if there is none, or else when they are taken."""
        with self._lock:
            if not self._is_empty:
                self._counts.append(_Count(answer))
                return
        answer(0)

    def take_all(self, take: Callable[[zenoh.Sample], None], duty: Duty) -> None:
        """Take all messages until the subscription ends, with the thread that calls this. duty: has each in hand."""
        look, wait, counts = self._handler.try_recv, self._handler.recv, self._counts
        while True:
            try:
                sample = look()
                if sample is None:
                    self._note_empty()
                    sample = wait()
                    self._is_empty = False
            except zenoh.ZError:  # it has ended, and all is taken
                break
            duty.in_hand = sample
            take(sample)
            duty.in_hand = None
            if counts:
                self._count()
        self._note_empty()

    def _count(self) -> None:
        """Count a message that was taken."""
        with self._lock:
            for count in self._counts:
                count.taken += 1
            full = [count for count in self._counts if count.taken >= self._most]
            self._counts[:] = [count for count in self._counts if count.taken < self._most]
        for count in full:
            count.answer(count.taken)

    def _note_empty(self) -> None:
        with self._lock:
            self._is_empty = True
            counts = [*self._counts]
            self._counts.clear()
        for count in counts:
            count.answer(count.taken)
