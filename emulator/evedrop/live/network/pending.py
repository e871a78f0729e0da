"""The messages of one key that have arrived and are not handled yet: all of them, so that they can be handled at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import final

from evedrop.live.network.process_session import Received
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.packets import is_barrier, is_resend

_MOST_SLOTS = 64
_BLOCK_BYTES = 1 << 18  # of the numbers of a block, so that it stays in the processor's cache


def most_slots(brief: AnyBrief) -> int:
    """How many slots a process of a run handles at once at most."""
    return max(1, min(_MOST_SLOTS, _BLOCK_BYTES // (8 * len(brief.model.A) * brief.trials)))


@final
class Pending:
    """Reads packets, or deliveries, and the barriers between them from a subscription, as many messages ahead as have arrived."""

    def __init__(self, subscription: Received, key: str, most: int) -> None:
        """most: how many messages to read ahead."""
        self._subscription, self._key, self._most = subscription, key, most
        self._messages: deque[Reader] = deque()

    def peek(self) -> Reader:
        """The next message, which stays the next until it is taken or dropped; waits for it if need be."""
        if not self._messages:
            self._messages.extend(Reader(self._key, payload) for payload in self._subscription.take(self._most))
        return self._messages[0]

    def drop(self) -> None:
        """Remove the next message, which `peek` has returned."""
        self._messages.popleft()

    def take_messages(self, first: int, most: int) -> list[Reader]:
        """Take the packets of slots `first`, `first` + 1, … without a gap or a barrier, as many as have arrived, up to `most`.

        The next message must be the packet of slot `first`.
        """
        found = [self._messages.popleft()]
        while len(found) < most and self._messages:
            message = self._messages[0]
            if message.fields.get("k") != first + len(found) or is_barrier(message) or is_resend(message):
                break
            found.append(self._messages.popleft())
        return found

    def __iter__(self) -> Iterator[Reader]:
        """All messages that still come, until the connection is closed."""
        while self._messages:
            yield self._messages.popleft()
        for payload in self._subscription:
            yield Reader(self._key, payload)
