"""Publishers, subscribers and other entities that a process declares on its session, and again on each later session.

The process keeps one object: it reads a subscription without a break while another subscriber replaces the subscription's own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import SimpleQueue
from typing import Protocol, final

import zenoh
from zenoh.handlers import FifoChannel

from evedrop.live.protocol.envelope import Dropped, head_of
from evedrop.live.protocol.process_status import StatusReporter


class Declared(Protocol):
    """An object that is declared on every session of a process."""

    def declare(self, session: zenoh.Session) -> None:
        """Declare it on this session; the previous session is closed."""


class SubscriptionClosedError(Exception):
    """The process has closed its connection: nothing will arrive any more."""


@final
class Subscription:
    """A subscription to one exact key, read in order with `recv`."""

    def __init__(self, key: str, dropped: Dropped, status: StatusReporter, room: int) -> None:
        """status: of the process, which records there that it waits; room: how many messages it holds."""
        self._room = room
        self._key, self._head, self._dropped, self._status = key, head_of(key), dropped, status
        self._waits = (key,)
        self._subscribers: SimpleQueue[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None] = SimpleQueue()
        self._subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe; messages that arrived on earlier sessions are read first."""
        self._subscribers.put(session.declare_subscriber(self._key, FifoChannel(self._room)))

    def close(self) -> None:
        """End the subscription: there will be no other session."""
        self._subscribers.put(None)

    def recv(self) -> bytes:
        """The next message. Raises SubscriptionClosedError once the connection is closed for good."""
        self._status.waits = self._waits
        payload = self._received()
        self._status.waits = ()
        return payload

    def take(self, most: int) -> list[bytes]:
        """Wait for the next message; then it, and those that have arrived after it, up to `most` in all.

        Raises SubscriptionClosedError as `recv` does.
        """
        found = [self.recv()]
        while len(found) < most and self._subscriber is not None:
            try:
                sample = self._subscriber.try_recv()
            except zenoh.ZError:  # as for `recv`, which continues with the next session
                break
            if sample is None:
                break
            payload = self._dropped.contents(self._key, self._head, sample.payload.to_bytes())
            if payload is not None:
                found.append(payload)
        return found

    def _received(self) -> bytes:
        while True:
            if self._subscriber is None:
                self._subscriber = self._subscribers.get()
                if self._subscriber is None:
                    raise SubscriptionClosedError(self._key)
            try:
                message = self._subscriber.recv().payload.to_bytes()
            except zenoh.ZError:  # its session is closed, and all messages that had arrived are read
                self._subscriber = None
                continue
            payload = self._dropped.contents(self._key, self._head, message)
            if payload is not None:
                return payload

    def __iter__(self) -> Iterator[bytes]:
        with suppress(SubscriptionClosedError):
            while True:
                yield self.recv()


@final
class CallbackSubscription:
    """A subscription to one exact key; a thread of Zenoh's hands its messages on."""

    def __init__(self, key: str, dropped: Dropped, receive: Callable[[bytes], None]) -> None:
        self._key, self._head, self._dropped, self._receive = key, head_of(key), dropped, receive

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe."""
        session.declare_subscriber(self._key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        payload = self._dropped.contents(self._key, self._head, sample.payload.to_bytes())
        if payload is not None:
            self._receive(payload)


@final
class Publisher:
    """A publisher for one exact key. Messages put without a connection are lost, and sent again in a later round."""

    def __init__(self, key: str) -> None:
        self.key, self._head = key, head_of(key)
        self._session: zenoh.Session | None = None
        self._publisher: zenoh.Publisher | None = None

    def declare(self, session: zenoh.Session) -> None:
        """Publish on this session from now on."""
        self._publisher = session.declare_publisher(
            self.key, congestion_control=zenoh.CongestionControl.BLOCK, reliability=zenoh.Reliability.RELIABLE
        )
        self._session = session

    def __call__(self, payload: bytes) -> None:
        """Put a message."""
        publisher, session = self._publisher, self._session
        if publisher is None or session is None:
            return
        try:
            publisher.put(self._head + payload)
        except zenoh.ZError:
            if not session.is_closed():
                raise

    @property
    def matched(self) -> bool:
        """Whether the key has a reader."""
        publisher, session = self._publisher, self._session
        if publisher is None or session is None or session.is_closed():
            return False
        with suppress(zenoh.ZError):
            return bool(publisher.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool
        return False


@final
class Question:
    """A question from another process, to be answered once."""

    def __init__(self, key: str, query: zenoh.Query, payload: bytes) -> None:
        self._key, self._query = key, query
        self.payload = payload

    def answer(self, payload: bytes) -> None:
        """Send the answer, if the asking process is still connected."""
        with suppress(zenoh.ZError):
            self._query.reply(self._key, head_of(self._key) + payload)
        self._query.drop()


@final
class Questions:
    """A key at which this process answers questions; a thread of Zenoh's hands each question on."""

    def __init__(self, key: str, dropped: Dropped, receive: Callable[[Question], None]) -> None:
        self._key, self._head, self._dropped, self._receive = key, head_of(key), dropped, receive

    def declare(self, session: zenoh.Session) -> None:
        """Accept questions on this session."""
        session.declare_queryable(self._key, self._take)

    def _take(self, query: zenoh.Query) -> None:
        message = b"" if query.payload is None else query.payload.to_bytes()
        payload = self._dropped.contents(self._key, self._head, message)
        if payload is None:
            query.drop()
        else:
            self._receive(Question(self._key, query, payload))


@final
class Watch:
    """Whether a process is on the network. Calls `changed` at every change, on a thread of Zenoh's or of the connection's."""

    def __init__(self, key: str, changed: Callable[[bool], None]) -> None:
        self._key, self._changed = key, changed
        self._lock = threading.Lock()
        self._session = 0
        """Number of the session that it listens to: messages of an earlier session are out of date."""
        self._there = False

    def declare(self, session: zenoh.Session) -> None:
        """Watch on this session, beginning with the present state."""
        with self._lock:
            self._session += 1
            number = self._session
        session.liveliness().declare_subscriber(
            self._key, lambda sample: self._note(number, sample.kind == zenoh.SampleKind.PUT), history=True
        )

    def lose(self) -> None:
        """Handle the loss of the connection: the process counts as absent."""
        with self._lock:
            self._session += 1
            number = self._session
        self._note(number, there=False)

    def _note(self, number: int, there: bool) -> None:
        with self._lock:
            if number == self._session and there != self._there:
                self._there = there
                self._changed(there)
