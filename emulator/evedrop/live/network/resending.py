"""Messages that may be lost with a connection are kept, and sent again when the conductor asks for them.

Messages are not acknowledged one by one. The sensor is never further than the window ahead of the slots that the recorder
has written, so messages older than a window are no longer needed and are forgotten.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import final

from evedrop.errors import Gap
from evedrop.live.network.clock import SYSTEM_CLOCK, Clock
from evedrop.live.protocol.codec import Reader


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
        self._messages: deque[tuple[int, bytes]] = deque()
        self._forgotten = 0
        self._lock = threading.Lock()

    def __call__(self, k: int, payload: bytes) -> None:
        """Send a message that belongs to slot k, and keep it."""
        with self._lock:
            self._messages.append((k, payload))
            self._put(payload)
        if self._span is not None:
            self.forget(k - self._span)

    def forget(self, k: int) -> None:
        """Forget messages of slots below k, which are done, except the `back` slots before k."""
        with self._lock:
            self._forgotten = max(self._forgotten, k)
            while self._messages and self._messages[0][0] < k - self._back:
                self._messages.popleft()

    def again(self, number: int, k: int) -> None:
        """Send the messages of slots from k on, which are not done, again; the last message in any case."""
        with self._lock:
            k = max(k, self._forgotten)  # a late request must not announce slots that are forgotten
            first = max(0, k - self._back)
            if self._head is not None:
                self._put(self._head(number, k, first))
            for place, (slot, payload) in enumerate(self._messages, 1):
                if slot >= first or place == len(self._messages):
                    self._put(payload)


@final
class GapDetector:
    """Handles messages of slots that are not due: ignores earlier slots, and for later ones waits for the missing slot."""

    def __init__(self, key: str, patience: float, clock: Clock = SYSTEM_CLOCK) -> None:
        """patience: for how many seconds later slots may arrive while the due one does not."""
        self._key, self._patience, self._clock = key, patience, clock
        self._slot, self._since = -1, 0.0

    def take_message(self, receive: Callable[[], Reader], due: int) -> Reader:
        """Wait for the message of slot `due`. Raises Gap as `missed` does."""
        while (found := (message := receive()).integer("k")) != due:
            self.missed(due, found)
        return message

    def missed(self, due: int, found: int) -> None:
        """Slot `found` arrived when `due` was expected. Raises Gap if slot `due` has been missing for too long."""
        now = self._clock.monotonic()
        if found < due:
            return
        if self._slot != due:
            self._slot, self._since = due, now
        elif now - self._since > self._patience:
            raise Gap(self._key, due, found)
