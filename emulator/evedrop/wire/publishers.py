"""How a wire publishes at a side: by a publisher for a key that comes often, and without one for all others.

Payloads stay in Zenoh's memory: nothing here copies one into Python.

Source: docs/wire.md, how messages cross.
"""

from __future__ import annotations

import threading
from typing import Any, final

import zenoh

MOST_PUBLISHERS = 1024
"""Publishers that are declared at a side."""
OFTEN = 100
"""Messages of a key over a link until a publisher is declared for it: this costs as much as it saves for as many messages."""
REMOTE = zenoh.Locality.REMOTE


@final
class Publishers:
    """The publishers that a wire has declared at a side, at most `MOST_PUBLISHERS`."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self._count = 0
        self._lock = threading.Lock()

    def declare(self, sample: zenoh.Sample, congestion: zenoh.CongestionControl) -> zenoh.Publisher | None:
        """A publisher with the key, priority and express of a sample; None if there are too many. Raises zenoh.ZError."""
        with self._lock:
            if self._count >= MOST_PUBLISHERS:
                return None
            self._count += 1
        try:
            return self.session.declare_publisher(
                sample.key_expr,
                priority=sample.priority,
                congestion_control=congestion,
                express=sample.express,
                allowed_destination=REMOTE,
            )
        except zenoh.ZError:
            self._release()
            raise

    def release(self, publisher: zenoh.Publisher) -> None:
        """Undeclare a publisher."""
        publisher.undeclare()
        self._release()

    def _release(self) -> None:
        with self._lock:
            self._count -= 1


@final
class Message:
    """A message that is published whole, without a publisher, when it is called."""

    __slots__ = ("_congestion", "_copies", "_sample", "_session")

    def __init__(
        self, session: zenoh.Session, sample: zenoh.Sample, congestion: zenoh.CongestionControl, copies: int
    ) -> None:
        self._session, self._sample, self._congestion, self._copies = session, sample, congestion, copies

    def __call__(self) -> None:
        """Publish all copies. Raises zenoh.ZError."""
        sample = self._sample
        how: dict[str, Any] = {
            "congestion_control": self._congestion,
            "priority": sample.priority,
            "express": sample.express,
            "attachment": sample.attachment,
            "timestamp": sample.timestamp,
            "allowed_destination": REMOTE,
            "source_info": sample.source_info,
        }
        for _ in range(self._copies):
            if sample.kind == zenoh.SampleKind.PUT:
                self._session.put(sample.key_expr, sample.payload, encoding=sample.encoding, **how)
            else:
                self._session.delete(sample.key_expr, **how)
