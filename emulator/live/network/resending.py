"""What may be lost with a connection is kept, and sent once more when the conductor asks for it.

Nothing is acknowledged by itself. The sensor is never further than the window ahead of what the observer has written, so
whatever is older than a window has done its work and is forgotten.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from evedrop.errors import Gap
from evedrop.live.protocol.codec import Reader


class ReplayBuffer:
    """An outlet that keeps what went through it; for several threads. Final.

    span: what is older than so many slots is forgotten; None: only what `forget` says.
    head: makes a message that goes before those that are sent once more, of (round, first slot that is not done, first slot
    that follows).
    back: so many slots more are sent than are not done.
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
        """Send what belongs to slot k, and keep it."""
        with self._lock:
            self._messages.append((k, payload))
            self._put(payload)
        if self._span is not None:
            self.forget(k - self._span)

    def forget(self, k: int) -> None:
        """Slots below k are done, and so many before them as are sent with them."""
        with self._lock:
            self._forgotten = max(self._forgotten, k)
            while self._messages and self._messages[0][0] < k - self._back:
                self._messages.popleft()

    def again(self, number: int, k: int) -> None:
        """Send once more what belongs to slots that are not done, those from k on; the last message in any case."""
        with self._lock:
            k = max(k, self._forgotten)  # a round that is asked for late must not announce slots that are gone
            first = max(0, k - self._back)
            if self._head is not None:
                self._put(self._head(number, k, first))
            for place, (slot, payload) in enumerate(self._messages, 1):
                if slot >= first or place == len(self._messages):
                    self._put(payload)


class GapDetector:
    """What a reader makes of slots that are not due: older ones it has, for later ones it waits. Final."""

    def __init__(self, key: str, patience: float) -> None:
        """patience: how many seconds later slots may arrive while the one that is due does not."""
        self._key, self._patience = key, patience
        self._slot, self._since = -1, 0.0

    def take(self, receive: Callable[[], Reader], due: int) -> Reader:
        """The message of slot `due`, as soon as it is received. Raises Gap as `missed` does."""
        while (found := (message := receive()).integer("k")) != due:
            self.missed(due, found)
        return message

    def missed(self, due: int, found: int) -> None:
        """Slot `found` arrived where `due` was due. Raises Gap if that one has been missing for too long."""
        now = time.monotonic()
        if found < due:
            return
        if self._slot != due:
            self._slot, self._since = due, now
        elif now - self._since > self._patience:
            raise Gap(self._key, due, found)
