"""A mailbox of unread messages: holds at most as many bytes from each sender as a run can have in flight."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from queue import SimpleQueue
from typing import final

from evedrop.errors import MalformedMessage
from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.live.protocol.keys import writer_of

_OVERHEAD_BYTES = 200  # of a message in memory, besides its payload
_ROUNDS = 4  # of resending all kept messages, before the first one is read


def allowance(largest: int, window: int, batch: int) -> int:
    """How many unread bytes of one sender may wait: reports of a window and two batches, in some rounds, and a reserve."""
    return _ROUNDS * (window // batch + 3) * (largest + _OVERHEAD_BYTES) + 2**20


@final
class Mailbox:
    """A queue of messages by sender; filled by threads of Zenoh's, read by one."""

    def __init__(self, keys: Mapping[str, str], most: int, clock: Clock = SYSTEM_CLOCK) -> None:
        """keys: sender → the key on which it sends; most: how many bytes of one sender may wait."""
        self._keys, self._most, self._clock = keys, most, clock
        self._queue: SimpleQueue[tuple[str, bytes | bool]] = SimpleQueue()
        self._waiting = dict.fromkeys(keys, 0)
        self._lock = threading.Lock()
        self._flooded: tuple[str, bytes] | None = None

    def put(self, sender: str, item: bytes | bool) -> None:
        """Put a message, or whether the sender is present. If a sender sends too much, its further messages are dropped."""
        if isinstance(item, bytes):
            with self._lock:
                waiting = self._waiting[sender] + len(item) + _OVERHEAD_BYTES
                if waiting > self._most:
                    self._flooded = self._flooded or (sender, item)
                    return
                self._waiting[sender] = waiting
        self._queue.put((sender, item))

    def __len__(self) -> int:
        """How many messages wait."""
        return self._queue.qsize()

    def get(self, timeout: float | None = None) -> tuple[str, bytes | bool]:
        """Wait for the next message. Raises Empty after `timeout` seconds, MalformedMessage if a sender has sent too much."""
        if self._flooded is not None:
            flooding, last = self._flooded
            key = self._keys[flooding]
            raise MalformedMessage(
                key,
                f"more than {self._most} unread bytes",
                "no more than the window of the run",
                last,
                writer_of(key),
            )
        sender, item = self._clock.next(self._queue, timeout)
        if isinstance(item, bytes):
            with self._lock:
                self._waiting[sender] -= len(item) + _OVERHEAD_BYTES
        return sender, item
