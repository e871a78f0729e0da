"""What a process declares on its session, in a form that can be declared again on the next session.

Each keeps what it has towards the process: an inbox is read on without a break while its subscriber is replaced by another.
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
from evedrop.live.protocol.whereabouts import Place


class Declared(Protocol):
    """Anything that is declared on every session of a process."""

    def declare(self, session: zenoh.Session) -> None:
        """Declare it on this session; the former one is closed."""


class InboxClosedError(Exception):
    """The process has closed its connection: nothing will arrive any more."""


@final
class Inbox:
    """A subscription to one exact key, read in order with `recv`."""

    def __init__(self, key: str, dropped: Dropped, place: Place, room: int) -> None:
        """place: of the process, which is there waiting while it reads; room: for so many messages."""
        self._room = room
        self._key, self._head, self._dropped, self._place = key, head_of(key), dropped, place
        self._waits = (key,)
        self._subscribers: SimpleQueue[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None] = SimpleQueue()
        self._subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe; what arrived before is read first."""
        self._subscribers.put(session.declare_subscriber(self._key, FifoChannel(self._room)))

    def close(self) -> None:
        """There will be no other session."""
        self._subscribers.put(None)

    def recv(self) -> bytes:
        """The next message. Raises InboxClosedError once the connection is closed for good."""
        self._place.waits = self._waits
        payload = self._received()
        self._place.waits = ()
        return payload

    def _received(self) -> bytes:
        while True:
            if self._subscriber is None:
                self._subscriber = self._subscribers.get()
                if self._subscriber is None:
                    raise InboxClosedError(self._key)
            try:
                message = self._subscriber.recv().payload.to_bytes()
            except zenoh.ZError:  # its session is closed, and all that had arrived is read
                self._subscriber = None
                continue
            payload = self._dropped.contents(self._key, self._head, message)
            if payload is not None:
                return payload

    def __iter__(self) -> Iterator[bytes]:
        with suppress(InboxClosedError):
            while True:
                yield self.recv()


@final
class Funnel:
    """A subscription to one exact key whose messages are handed on by a thread of Zenoh's."""

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
class Outlet:
    """A publisher for one exact key. What is put while there is no connection is lost, and sent again in a later round."""

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
        """Whether somebody reads the key."""
        publisher, session = self._publisher, self._session
        if publisher is None or session is None or session.is_closed():
            return False
        with suppress(zenoh.ZError):
            return bool(publisher.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool
        return False


class Question:
    """What somebody asks, to be answered once. Final."""

    def __init__(self, key: str, query: zenoh.Query, payload: bytes) -> None:
        self._key, self._query = key, query
        self.payload = payload

    def answer(self, payload: bytes) -> None:
        """Send the answer, if whoever asked is still there."""
        with suppress(zenoh.ZError):
            self._query.reply(self._key, head_of(self._key) + payload)
        self._query.drop()  # type: ignore[no-untyped-call]


@final
class Questions:
    """A key at which this process is asked; each question is handed on by a thread of Zenoh's."""

    def __init__(self, key: str, dropped: Dropped, receive: Callable[[Question], None]) -> None:
        self._key, self._head, self._dropped, self._receive = key, head_of(key), dropped, receive

    def declare(self, session: zenoh.Session) -> None:
        """Be asked."""
        session.declare_queryable(self._key, self._take)

    def _take(self, query: zenoh.Query) -> None:
        message = b"" if query.payload is None else query.payload.to_bytes()
        payload = self._dropped.contents(self._key, self._head, message)
        if payload is None:
            query.drop()  # type: ignore[no-untyped-call]
        else:
            self._receive(Question(self._key, query, payload))


@final
class Watch:
    """Whether a process is on the network. `changed` is told of every change, on a thread of Zenoh's or of the connection's."""

    def __init__(self, key: str, changed: Callable[[bool], None]) -> None:
        self._key, self._changed = key, changed
        self._lock = threading.Lock()
        self._session = 0
        """Number of the session that it listens to: what an earlier one still says is out of date."""
        self._there = False

    def declare(self, session: zenoh.Session) -> None:
        """Watch, beginning with how it is now."""
        with self._lock:
            self._session += 1
            number = self._session
        session.liveliness().declare_subscriber(
            self._key, lambda sample: self._note(number, sample.kind == zenoh.SampleKind.PUT), history=True
        )

    def lose(self) -> None:
        """The connection is lost, and with it the sight of everybody."""
        with self._lock:
            self._session += 1
            number = self._session
        self._note(number, there=False)

    def _note(self, number: int, there: bool) -> None:
        with self._lock:
            if number == self._session and there != self._there:
                self._there = there
                self._changed(there)
