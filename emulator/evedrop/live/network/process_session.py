"""What the work of a process uses with its session: messages to take, and messages to send.

A mailbox holds at most as many bytes from each sender as a run can have in flight. All messages of a key that have arrived and
are not handled yet are taken at once. Messages that may be lost with a connection are kept, and sent again when the conductor
asks for them. They are not acknowledged one by one: the sensor is never further than the window ahead of the slots that the
recorder has written, so messages older than a window are no longer needed and are forgotten.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import final

from evedrop.errors import Gap, MalformedMessage
from evedrop.live.network.connection import Subscription
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.keys import writer_of
from evedrop.system.threads import Queue
from evedrop.system.world import world

LEAST_SECONDS = 5.0
"""The least time for which a process waits for another one: a busy machine may not let a process work for some seconds."""
_LEAST_GAP = 4.0  # seconds: after the recorder has had messages sent again, and before it calls a process silent
_LEAST_STEP = 2.0  # seconds that count between two later slots, if as many have passed
_AHEAD = 64  # messages


@final
class Pending:
    """Reads packets, or deliveries, and the barriers between them from a subscription, as many messages ahead as have arrived."""

    def __init__(self, subscription: Subscription, key: str) -> None:
        self._subscription, self._key = subscription, key
        self._messages: deque[Reader] = deque()

    def peek(self) -> Reader:
        """The next message, which stays the next until it is taken or dropped; waits for it if need be."""
        if not self._messages:
            self._messages.extend(Reader(self._key, payload) for payload in self._subscription.take(_AHEAD))
        return self._messages[0]

    def drop(self) -> Reader:
        """Remove the next message, which `peek` has returned."""
        return self._messages.popleft()

    def __iter__(self) -> Iterator[Reader]:
        """All messages that still come, until the connection is closed."""
        while self._messages:
            yield self._messages.popleft()
        for payload in self._subscription:
            yield Reader(self._key, payload)


_OVERHEAD_BYTES = 200  # of a message in memory, besides its payload
_ROUNDS = 4  # of resending all kept messages, before the first one is read


def allowance(largest: int, window: int, batch: int) -> int:
    """How many unread bytes of one sender may wait: reports of a window and two batches, in some rounds, and a reserve.

    largest: bytes of the largest report; each may be in parts of a slot, as in a run that is held again and again.
    """
    reports = window // batch + 3
    return _ROUNDS * reports * (largest + batch * 2 * _OVERHEAD_BYTES) + 2**20


@final
class Mailbox:
    """A queue of messages by sender; filled by threads of Zenoh's, read by one."""

    def __init__(self, keys: Mapping[str, str], most: int) -> None:
        """keys: sender → the key on which it sends; most: how many bytes of one sender may wait."""
        self._keys, self._most = keys, most
        self._queue: Queue[tuple[str, bytes | bool]] = world().queue()
        self._waiting = dict.fromkeys(keys, 0)
        self._lock = world().lock()
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
        sender, item = self._queue.get(timeout=timeout)
        if isinstance(item, bytes):
            with self._lock:
                self._waiting[sender] -= len(item) + _OVERHEAD_BYTES
        return sender, item


@final
class ReplayBuffer:
    """A publisher that keeps the messages sent through it; thread-safe.

    span: messages older than this many slots are forgotten; None: only `forget` forgets.
    head: makes the message that precedes the resent ones, from (round, first slot that is not done, first slot that is
    resent).
    back: how many slots before the first that is not done are resent, too.
    """

    def __init__(
        self,
        put: Callable[[bytes], None],
        span: int | None = None,
        head: Callable[[int, int, int], bytes] | None = None,
        back: int = 0,
    ) -> None:
        self._put, self._span, self._head, self._back = put, span, head, back
        self._messages: deque[tuple[int, int, bytes]] = deque()
        """First slot, last slot, and the message."""
        self._forgotten = 0
        self._lock = world().lock()

    def __call__(self, k: int, payload: bytes, first: int | None = None) -> None:
        """Send a message that ends with slot k, and keep it; first: the slot with which it begins, if not with k."""
        with self._lock:
            self._messages.append((k if first is None else first, k, payload))
            self._put(payload)
        if self._span is not None:
            self.forget(k - self._span)

    def forget(self, k: int) -> None:
        """Forget messages of slots below k, which are done, except the `back` slots before k."""
        with self._lock:
            self._forgotten = max(self._forgotten, k)
            while self._messages and self._messages[0][1] < k - self._back:
                self._messages.popleft()

    def again(self, number: int, k: int) -> None:
        """Send the messages of slots from k on, which are not done, again; the last message in any case."""
        with self._lock:
            k = max(k, self._forgotten)  # a late request must not announce slots that are forgotten
            oldest = max(0, k - self._back)
            again = [message for message in self._messages if message[1] >= oldest] or list(self._messages)[-1:]
            if self._head is not None:  # the oldest message may begin before the first slot that is needed
                self._put(self._head(number, k, min([oldest, *(first for first, _, _ in again[:1])])))
            for _, _, payload in again:
                self._put(payload)


@final
class GapDetector:
    """Handles messages of slots that are not due: ignores earlier slots, and for later ones waits for the missing slot."""

    def __init__(self, key: str, patience: float) -> None:
        """patience: for how many seconds later slots may arrive while the due one does not; at least `_LEAST_GAP`.

        The recorder needs some of them to notice the loss. Time in which this process did not run hardly counts: the message may
        already be here, unread.
        """
        self._key, self._patience = key, max(_LEAST_GAP, patience)
        self._step = max(_LEAST_STEP, self._patience / 4.0)
        self._slot, self._last, self._missing = -1, 0.0, 0.0

    def missed(self, due: int, slot: int) -> None:
        """Slot `slot` arrived when `due` was expected. Raises Gap if slot `due` has been missing for too long."""
        now = world().monotonic()
        if slot < due:
            return
        if self._slot != due:
            self._slot, self._missing = due, 0.0
        else:
            self._missing += min(now - self._last, self._step)
        self._last = now
        if self._missing > self._patience:
            raise Gap(self._key, due, slot)


@final
class InOrder:
    """Reads the messages of one key, each when its slot is due."""

    def __init__(self, subscription: Subscription, key: str, patience: float) -> None:
        """patience: as in `GapDetector`."""
        self._subscription, self._key = subscription, key
        self._gaps = GapDetector(key, patience)

    def take(self, due: int) -> Reader:
        """Wait for the message of slot `due`. Raises Gap as `GapDetector.missed` does."""
        while (slot := (message := Reader(self._key, self._subscription.recv())).integer("k")) != due:
            self._gaps.missed(due, slot)
        return message
