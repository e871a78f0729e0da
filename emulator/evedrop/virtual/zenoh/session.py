"""A simulated session of Zenoh: what a process declares, puts and gets, and what a router passes on.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self, final

import zenoh

from evedrop.virtual import notes
from evedrop.virtual.scheduler import VirtualQueue, VirtualScheduler, VirtualTask, Waiter
from evedrop.virtual.zenoh.access import Access, includes, intersects, section
from evedrop.virtual.zenoh.transport import Details, End, TransportFrame

_LEASE_MS = 10_000
_PATIENCE_US = 5_000_000
_QUERY_SECONDS = 10.0


class VirtualSample(NamedTuple):
    """A message as its reader gets it."""

    key_expr: str
    payload: zenoh.ZBytes
    kind: zenoh.SampleKind = zenoh.SampleKind.PUT
    encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES
    attachment: zenoh.ZBytes | None = None
    timestamp: zenoh.Timestamp | None = None
    source_info: zenoh.SourceInfo | None = None
    priority: zenoh.Priority = zenoh.Priority.DATA
    congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.BLOCK
    express: bool = False

    @classmethod
    def of(cls, frame: TransportFrame, key: str | None = None) -> VirtualSample:
        """The message of a frame; key: another one than its own."""
        return cls(frame.key if key is None else key, zenoh.ZBytes(frame.payload), *frame.details)


@dataclass(frozen=True)
class VirtualTransport:
    """Who is at the other end of a connection."""

    zid: str
    whatami: zenoh.WhatAmI
    auth_identifier: str | None
    dst: str


@dataclass(frozen=True)
class TransportEvent:
    """A connection that was made (`PUT`) or lost (`DELETE`)."""

    kind: zenoh.SampleKind
    transport: VirtualTransport

    @property
    def link(self) -> VirtualTransport:
        """The same: a connection has one link."""
        return self.transport


def _bytes_of(payload: bytes | str | zenoh.ZBytes | None) -> bytes:
    if payload is None or isinstance(payload, bytes):
        return payload or b""
    return payload.encode() if isinstance(payload, str) else payload.to_bytes()


@dataclass(frozen=True)
class MatchingStatus:
    """Whether somebody reads what is published."""

    matching: bool


@dataclass(frozen=True)
class VirtualReply:
    """An answer to a question."""

    ok: VirtualSample | None
    err: None = None


@final
class FifoChannel:
    """A handler that keeps up to `capacity` messages; then the session's receiving thread waits."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity


@final
class Callback:
    """A handler that calls a function with each item, and another one when no more will come."""

    def __init__(
        self, callback: Callable[[Any], object], drop: Callable[[], object] | None = None, *, indirect: bool = True
    ) -> None:
        del indirect
        self._callback, self._drop = callback, drop

    def __call__(self, item: Any) -> None:
        """Take an item."""
        self._callback(item)

    def end(self) -> None:
        """No more will come."""
        if self._drop is not None:
            self._drop()


@final
class VirtualSubscriber:
    """The messages of a key expression, as a channel keeps them or a function gets them."""

    def __init__(
        self,
        session: VirtualSession,
        key: str,
        handler: FifoChannel | Callable[[VirtualSample], object],
        remote: bool = False,
    ) -> None:
        """remote: whether messages of its own session are none of its business."""
        self.session, self.key, self._handler, self.remote = session, key, handler, remote
        self._kept: deque[VirtualSample] = deque()
        self._readers: deque[Waiter] = deque()
        self._full: deque[Waiter] = deque()
        self._over = False

    def take(self, sample: VirtualSample) -> None:
        """Get a message, on the session's receiving thread."""
        if not isinstance(self._handler, FifoChannel):
            if not self._over:
                self._handler(sample)
            return
        while len(self._kept) >= self._handler.capacity and not self._over:
            self.session.scheduler.wait(self._full)
        if not self._over:
            self._kept.append(sample)
            self.session.scheduler.wake(self._readers)

    @property
    def handler(self) -> VirtualSubscriber:
        """What keeps its messages."""
        return self

    def recv(self) -> VirtualSample:
        """Wait for the next message. Raises ZError once it is undeclared and all are read."""
        while (sample := self.try_recv()) is None:
            self.session.scheduler.wait(self._readers)
        return sample

    def try_recv(self) -> VirtualSample | None:
        """The next message, if there is one. Raises ZError once it is undeclared and all are read."""
        if self._kept:
            sample = self._kept.popleft()
            self.session.scheduler.wake(self._full)
            return sample
        if self._over:
            raise zenoh.ZError("the subscriber is undeclared")
        return None

    def undeclare(self) -> None:
        """End it."""
        self.end()
        self.session.withdraw(self)

    def end(self) -> None:
        """Nothing comes any more."""
        self._over = True
        self.session.scheduler.wake(self._readers)
        self.session.scheduler.wake(self._full)


@final
class VirtualPublisher:
    """Puts messages on a key."""

    def __init__(self, session: VirtualSession, key: str, how: Mapping[str, Any]) -> None:
        """how: as for `VirtualSession.put`."""
        self._session, self._key, self._how = session, key, how

    def put(self, payload: bytes | str | zenoh.ZBytes, **details: Any) -> None:
        """Put a message. Raises ZError if the session is closed."""
        self._session.put(self._key, payload, **self._how, **details)

    def undeclare(self) -> None:
        """Nobody was told of it."""

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether somebody reads the key. Raises ZError if the session is closed."""
        return MatchingStatus(self._session.has_reader(self._key))


@final
class VirtualToken:
    """Shows that its process is there."""

    def __init__(self, session: VirtualSession, key: str) -> None:
        self._session, self._key = session, key

    def undeclare(self) -> None:
        """Withdraw it."""
        self._session.withdraw_token(self._key)


@final
class VirtualQuery:
    """A question, as the process that answers it gets it."""

    parameters = ""

    def __init__(self, session: VirtualSession, frame: TransportFrame, number: int) -> None:
        self._session, self.key_expr, self._number = session, frame.key, number
        self.payload = zenoh.ZBytes(frame.payload) if frame.payload else None
        self.encoding = frame.details.encoding
        self.attachment, self.source_info = frame.details.attachment, frame.details.source_info
        self._open = True

    @staticmethod
    def accepts_replies() -> zenoh.ReplyKeyExpr:
        """Answers have keys that the question has."""
        return zenoh.ReplyKeyExpr.MATCHING_QUERY

    def reply(self, key: str, payload: bytes | str | zenoh.ZBytes, **details: Any) -> None:
        """Answer it. Raises ZError if the session is closed."""
        self._session.expect_open()
        if self._open:
            frame = TransportFrame("reply", str(key), _bytes_of(payload), self._number, Details.of(**details))
            self._session.answer(frame)

    def drop(self) -> None:
        """Give no further answer."""
        if self._open:
            self._open = False
            self._session.answer(TransportFrame("final", self.key_expr, b"", self._number))


@final
@dataclass(frozen=True)
class VirtualQueryable:
    """Answers questions at a key expression, by a function."""

    session: VirtualSession
    key: str
    handler: Callable[[VirtualQuery], object]

    def undeclare(self) -> None:
        """Answer no more."""
        self.session.withdraw_queryable(self)


@final
class VirtualQuerier:
    """Asks others, but not its own session, at a key expression."""

    def __init__(self, session: VirtualSession, key: str, timeout: float) -> None:
        self._session, self._key, self._timeout = session, key, timeout

    def get(
        self,
        handler: Callback,
        *,
        payload: zenoh.ZBytes | None = None,
        parameters: str = "",
        encoding: zenoh.Encoding | None = None,
        attachment: zenoh.ZBytes | None = None,
        source_info: zenoh.SourceInfo | None = None,
    ) -> None:
        """Ask; the handler gets the answers, and is told when there are no more. Raises ZError if the session is closed."""
        del parameters
        details = Details.of(encoding=encoding, attachment=attachment, source_info=source_info)
        frame = TransportFrame("query", self._key, _bytes_of(payload), 0, details)
        self._session.ask(frame, self._timeout, HandedReplies(self._session, handler), remote=True)

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether somebody answers all questions at the key expression. Raises ZError if the session is closed."""
        return MatchingStatus(self._session.has_answer(self._key))

    def undeclare(self) -> None:
        """Nobody was told of it."""


@final
class HandedReplies:
    """Answers for a function, which a thread of the session calls."""

    def __init__(self, session: VirtualSession, handler: Callback) -> None:
        self._session, self._handler = session, handler

    def put(self, reply: VirtualReply | None) -> None:
        """Hand over an answer, or that there are no more."""
        scheduler = self._session.scheduler
        if scheduler.current is None:  # the time for answers is over
            scheduler.thread("replies", lambda: self._hand(reply), self._session.task).start()
        else:
            self._hand(reply)

    def _hand(self, reply: VirtualReply | None) -> None:
        if reply is None:
            self._handler.end()
        else:
            self._handler(reply)


@dataclass
class _Asked:
    """A question that a session has asked, or passed on."""

    asker: End | None
    """Who asked the session; None if the session itself did."""
    asked_as: int
    """Its number where it came from."""
    left: list[End | None]
    """Who has still to answer; None: a queryable of the session."""
    replies: VirtualQueue | HandedReplies | None = None


@final
class Replies:
    """The answers to a question, as they come."""

    def __init__(self, queue: VirtualQueue) -> None:
        self._queue = queue

    def __iter__(self) -> Iterator[VirtualReply]:
        while (reply := self._queue.get()) is not None:
            yield reply


@final
@dataclass
class Info:
    """The identity and connections of a session."""

    session: VirtualSession
    listeners: list[Callable[[TransportEvent], object]] = field(default_factory=list)

    def zid(self) -> str:
        """Its id."""
        return self.session.zid

    def routers_zid(self) -> list[str]:
        """The ids of the routers that it is connected with."""
        return [end.peer.zid for end in self.session.ends if end.to_router]

    def transports(self) -> list[VirtualTransport]:
        """Its connections."""
        return [transport_of(end) for end in self.session.ends]

    def declare_transport_events_listener(
        self, listener: Callable[[TransportEvent], object], *, history: bool = False
    ) -> None:
        """Call a function at each connection that is made or lost; history: and for those that are there."""
        self.listeners.append(listener)
        for end in self.session.ends if history else ():
            listener(TransportEvent(zenoh.SampleKind.PUT, transport_of(end)))

    declare_link_events_listener = declare_transport_events_listener


def transport_of(end: End) -> VirtualTransport:
    """A connection, as one of its ends sees it."""
    what = zenoh.WhatAmI.ROUTER if end.to_router else zenoh.WhatAmI.CLIENT
    return VirtualTransport(end.peer.zid, what, end.peer.user, f"tcp/{end.peer.zid}")


@final
@dataclass(frozen=True)
class VirtualWatch:
    """Calls a function when somebody comes or goes."""

    session: VirtualSession
    key: str
    handler: Callable[[VirtualSample], object]

    def undeclare(self) -> None:
        """Call it no more."""
        self.session.unwatch(self)


@final
class Liveliness:
    """Who is there."""

    def __init__(self, session: VirtualSession) -> None:
        self._session = session

    def declare_token(self, key: str) -> VirtualToken:
        """Show that this process is there."""
        return self._session.show_token(key)

    def declare_subscriber(
        self, key: str, handler: Callable[[VirtualSample], object], history: bool = False
    ) -> VirtualWatch:
        """Call a function when somebody comes or goes; history: also for who is there already."""
        return self._session.watch(key, handler, history)

    def get(self, key: str, handler: Callback | None = None, timeout: float = _QUERY_SECONDS) -> Replies | None:
        """Who is there now; the handler gets that, if there is one."""
        frame = TransportFrame("liveliness_query", key)
        if handler is None:
            return self._session.replies(frame, timeout)
        self._session.ask(frame, timeout, HandedReplies(self._session, handler))
        return None


class Network(Protocol):
    """The part of the network that its sessions use."""

    scheduler: VirtualScheduler

    def confused(self, session: VirtualSession) -> bool:
        """Whether the message that a session gets now is to arrive at the wrong subscriber."""

    def connect_again(self, session: VirtualSession) -> None:
        """Try to connect a session that has lost its router."""

    def forget(self, session: VirtualSession) -> None:
        """A session has ended."""


@final
class VirtualSession:
    """A session of a simulated process."""

    def __init__(self, network: Network, task: VirtualTask, config: zenoh.Config) -> None:
        self.network, self.task = network, task
        self.scheduler: VirtualScheduler = network.scheduler
        self.router = section(config, "mode") == "router"
        self.access = Access(config)
        self.name = task.name
        self.zid = section(config, "id") or f"z{self.scheduler.number()}"
        self.user, self.password = (section(config, f"transport/auth/usrpwd/{name}") for name in ("user", "password"))
        self.lease = (section(config, "transport/link/tx/lease") or _LEASE_MS) / 1e3
        waits = section(config, "transport/link/tx/queue/congestion_control/block/wait_before_close")
        self.patience = (waits or _PATIENCE_US) / 1e6
        retry = section(config, "connect/retry") or {}
        self.again = (retry.get("period_init_ms") or 1000) / 1e3
        """Seconds between attempts to connect again."""
        self.ends: list[End] = []
        self.places: list[str] = []
        """The endpoints that it listens at."""
        self.inbox = VirtualQueue(self.scheduler)
        self.info = Info(self)
        self._closed = False
        self._subscribers: list[VirtualSubscriber] = []
        self._answering: list[VirtualQueryable] = []
        self._tokens: list[str] = []
        self._watching: list[VirtualWatch] = []
        self._asked: dict[int, _Asked] = {}
        self.connects_to: str | None = None
        task.held.append(self._die)
        self.scheduler.thread("receives", self._receive, task).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # What programs call

    def is_closed(self) -> bool:
        """Whether it is closed."""
        return self._closed

    def expect_open(self) -> None:
        """Raise ZError if it is closed."""
        if self._closed:
            raise zenoh.ZError("the session is closed")

    def close(self) -> None:
        """Close it: its subscribers end, and others see it leave."""
        if not self._closed:
            self._end("closes", gracefully=True)
            self.task.held.remove(self._die)
            self.inbox.put(None)
            self.scheduler.interruptible()

    def liveliness(self) -> Liveliness:
        """Who is there."""
        return Liveliness(self)

    def declare_subscriber(
        self,
        key: str | zenoh.KeyExpr,
        handler: FifoChannel | Callable[[VirtualSample], object],
        *,
        allowed_origin: zenoh.Locality = zenoh.Locality.ANY,
    ) -> VirtualSubscriber:
        """Read a key expression. Raises ZError if the session is closed."""
        self.expect_open()
        subscriber = VirtualSubscriber(self, str(key), handler, allowed_origin == zenoh.Locality.REMOTE)
        self._subscribers.append(subscriber)
        self._declare("declare_subscriber", subscriber.key)
        return subscriber

    def withdraw(self, subscriber: VirtualSubscriber) -> None:
        """End a subscription."""
        if subscriber in self._subscribers:
            self._subscribers.remove(subscriber)
            self._withdraw("declare_subscriber", subscriber.key)

    def declare_publisher(
        self,
        key: str,
        congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.DROP,
        **how: Any,
    ) -> VirtualPublisher:
        """Publish on a key; how: as for `put`. Raises ZError if the session is closed."""
        self.expect_open()
        return VirtualPublisher(self, str(key), {**how, "congestion_control": congestion_control})

    def declare_queryable(
        self, key: str | zenoh.KeyExpr, handler: Callable[[VirtualQuery], object], **_: object
    ) -> VirtualQueryable:
        """Answer questions at a key expression. Raises ZError if the session is closed."""
        self.expect_open()
        queryable = VirtualQueryable(self, str(key), handler)
        self._answering.append(queryable)
        self._declare("declare_queryable", queryable.key)
        return queryable

    def withdraw_queryable(self, queryable: VirtualQueryable) -> None:
        """Answer no more questions there."""
        if queryable in self._answering:
            self._answering.remove(queryable)
            self._withdraw("declare_queryable", queryable.key)

    def declare_querier(self, key: str, timeout: float = _QUERY_SECONDS, **_: object) -> VirtualQuerier:
        """Ask others at a key expression. Raises ZError if the session is closed."""
        self.expect_open()
        return VirtualQuerier(self, str(key), timeout)

    def put(
        self,
        key: str,
        payload: bytes | str | zenoh.ZBytes,
        *,
        allowed_destination: zenoh.Locality = zenoh.Locality.ANY,
        **details: Any,
    ) -> None:
        """Put a message on a key; details: as `Details`. Raises ZError if the session is closed."""
        self.expect_open()
        message = _bytes_of(payload)
        self.scheduler.note(notes.PUT, notes.key_within(str(key)), len(message), notes.said_in(message))
        frame = TransportFrame("put", str(key), message, self.scheduler.events, Details.of(**details))
        self._pass_on(None, frame, remote=allowed_destination == zenoh.Locality.REMOTE)
        self.scheduler.interruptible()

    def delete(self, key: str, **how: Any) -> None:
        """Delete what is on a key. Raises ZError if the session is closed."""
        self.put(key, b"", kind=zenoh.SampleKind.DELETE, **how)

    def get(self, key: str, payload: bytes = b"", timeout: float = _QUERY_SECONDS) -> Replies:
        """Ask a question. Raises ZError if the session is closed."""
        return self.replies(TransportFrame("query", key, payload), timeout)

    def has_answer(self, key: str) -> bool:
        """Whether somebody else answers all questions at a key. Raises ZError if the session is closed."""
        self.expect_open()
        return any(includes(pattern, key) for end in self.ends for pattern in end.answers)

    def has_reader(self, key: str) -> bool:
        """Whether somebody else reads a key. Raises ZError if the session is closed."""
        self.expect_open()
        return any(intersects(pattern, key) for end in self.ends for pattern in end.subscribed)

    # Liveliness

    def show_token(self, key: str) -> VirtualToken:
        """Show a token. Raises ZError if the session is closed."""
        self.expect_open()
        self._tokens.append(key)
        self._tell_token(None, key, there=True)
        return VirtualToken(self, key)

    def withdraw_token(self, key: str) -> None:
        """Withdraw a token. Raises ZError if the session is closed."""
        self.expect_open()
        if key in self._tokens:
            self._tokens.remove(key)
            self._tell_token(None, key, there=False)

    def watch(self, key: str, handler: Callable[[VirtualSample], object], history: bool) -> VirtualWatch:
        """Watch tokens."""
        self.expect_open()
        watch = VirtualWatch(self, key, handler)
        self._watching.append(watch)
        if history:
            for token in self._known_tokens(key):
                self.inbox.put((None, TransportFrame("token", token), 0))
        for end in self.ends:
            end.send(TransportFrame("declare_liveliness_subscriber", key))
        return watch

    def unwatch(self, watch: VirtualWatch) -> None:
        """Watch tokens no more; others go on telling."""
        self._watching.remove(watch)

    def _known_tokens(self, key: str, but: End | None = None) -> list[str]:
        """The tokens of others that this session knows, from all ends but one."""
        return [token for end in self.ends if end is not but for token in end.tokens if intersects(key, token)]

    def _tell_token(self, source: End | None, key: str, *, there: bool) -> None:
        """Tell other ends that a token has come or gone."""
        kind = "token" if there else "no token"
        for end in self.ends:
            if end is source or (source is not None and not self.router):
                continue
            # Clients tell their router everything; a router tells those who want to know.
            wanted = (end.to_router and not self.router) or any(intersects(pattern, key) for pattern in end.watched)
            if wanted and self._lets_out(end, "liveliness_token", key):
                end.send(TransportFrame(kind, key))

    # Questions

    def replies(self, frame: TransportFrame, timeout: float) -> Replies:
        """Ask a question, and return its answers as they come. Raises ZError if the session is closed."""
        queue = VirtualQueue(self.scheduler)
        self.ask(frame, timeout, queue)
        return Replies(queue)

    def ask(
        self, frame: TransportFrame, timeout: float, replies: VirtualQueue | HandedReplies, *, remote: bool = False
    ) -> None:
        """Ask a question; remote: only others. Raises ZError if the session is closed."""
        self.expect_open()
        number = self._pass_question(None, frame, 0, replies, remote=remote)
        self.scheduler.at(self.scheduler.now + timeout, lambda: self._give_up(number))
        self.scheduler.interruptible()

    def _pass_question(
        self,
        source: End | None,
        frame: TransportFrame,
        asked_as: int,
        replies: VirtualQueue | HandedReplies | None = None,
        *,
        remote: bool = False,
    ) -> int:
        number = self.scheduler.number()
        targets: list[End] = []
        liveliness = frame.kind == "liveliness_query"
        for end in self.ends:
            if end is source or (source is not None and not self.router):
                continue
            upward = end.to_router and not self.router
            wanted = upward or (not liveliness and any(intersects(pattern, frame.key) for pattern in end.answers))
            if wanted and (upward or self.access.allows(end.peer, "egress", frame.kind, frame.key)):
                targets.append(end)
        own = () if liveliness or remote else self._answering
        handlers = [queryable.handler for queryable in own if intersects(queryable.key, frame.key)]
        self._asked[number] = asked = _Asked(source, asked_as, [*targets, *([None] * len(handlers))], replies)
        if liveliness and (source is None or self.router):
            for token in self._known_tokens(frame.key, but=source):
                self._reply(TransportFrame("reply", token), asked)
        for target in targets:
            target.send(frame._replace(number=number))
        for handler in handlers:
            handler(VirtualQuery(self, frame, number))
        if not asked.left and number in self._asked:  # unless a queryable has just ended it
            self._finish(number)
        return number

    def answer(self, frame: TransportFrame) -> None:
        """Send an answer, or the end of all answers, of a queryable of this session."""
        self._take_answer(None, frame)

    def _take_answer(self, source: End | None, frame: TransportFrame) -> None:
        asked = self._asked.get(frame.number)
        if asked is None:
            return
        if frame.kind == "reply":
            self._reply(frame, asked)
        elif source in asked.left:
            asked.left.remove(source)
            if not asked.left:
                self._finish(frame.number)

    def _reply(self, frame: TransportFrame, asked: _Asked) -> None:
        if asked.asker is not None:
            kind = "reply" if frame.payload else "liveliness_token"
            if self.access.allows(asked.asker.peer, "egress", kind, frame.key):
                asked.asker.send(frame._replace(number=asked.asked_as))
        elif asked.replies is not None:
            asked.replies.put(VirtualReply(VirtualSample.of(frame)))

    def _finish(self, number: int) -> None:
        asked = self._asked.pop(number)
        if asked.asker is not None:
            asked.asker.send(TransportFrame("final", "", b"", asked.asked_as))
        elif asked.replies is not None:
            asked.replies.put(None)

    def _give_up(self, number: int) -> None:
        if number in self._asked:
            self._finish(number)

    # Declarations

    def _declare(self, kind: str, key: str) -> None:
        for end in self.ends:
            self._tell(end, kind, key)
        self.scheduler.interruptible()

    def _withdraw(self, kind: str, key: str) -> None:
        for end in self.ends:
            end.send(TransportFrame(f"no {kind}", key))

    def _tell(self, end: End, kind: str, key: str) -> None:
        if self._lets_out(end, kind, key):
            end.send(TransportFrame(kind, key))

    def greet(self, end: End) -> None:
        """Tell a new end everything that is declared here, and, from a router, what others have declared."""
        others = [other for other in self.ends if other is not end and self.router]
        for subscriber in self._subscribers:
            self._tell(end, "declare_subscriber", subscriber.key)
        for queryable in self._answering:
            self._tell(end, "declare_queryable", queryable.key)
        for other in others:
            for key in other.subscribed:
                self._tell(end, "declare_subscriber", key)
            for key in other.answers:
                self._tell(end, "declare_queryable", key)
        watched = dict.fromkeys(
            [*(watch.key for watch in self._watching), *(key for other in others for key in other.watched)]
        )
        for key in watched:
            end.send(TransportFrame("declare_liveliness_subscriber", key))
        if not self.router:
            for key in self._tokens:
                end.send(TransportFrame("token", key))
        if self.info.listeners:
            self.inbox.put((end, TransportFrame("connected", ""), 0))

    # What arrives

    def _receive(self) -> None:
        """Deal with frames one after the other, as Zenoh's receiving thread does."""
        while (item := self.inbox.get()) is not None:
            end, frame, size = item
            if frame is None:
                self.lose(end)
                continue
            if end is None:
                self._tell_watchers(frame.key, there=True)
            elif end in self.ends:
                self._take(end, frame)
                end.taken(size)

    def _take(self, end: End, frame: TransportFrame) -> None:
        """Deal with a frame, if access control lets it in."""
        kind, key = frame.kind, frame.key
        if kind in _DECLARED:
            if self.access.allows(end.peer, "ingress", kind, key):
                declared = getattr(end, _DECLARED[kind])
                declared[key] = declared.get(key, 0) + 1
                self._tell_others(end, kind, key)
        elif kind in _WITHDRAWN:
            self._forget(end, _WITHDRAWN[kind], key)
        else:
            _TAKEN[kind](self, end, frame)

    def _take_put(self, end: End, frame: TransportFrame) -> None:
        if self._lets_in(end, frame, "put"):
            self._pass_on(end, frame)

    def _take_connection(self, end: End, _: TransportFrame) -> None:
        for listener in self.info.listeners:
            listener(TransportEvent(zenoh.SampleKind.PUT, transport_of(end)))

    def _take_token(self, end: End, frame: TransportFrame) -> None:
        if self.access.allows(end.peer, "ingress", "liveliness_token", frame.key) and frame.key not in end.tokens:
            end.tokens[frame.key] = None
            self._tell_watchers(frame.key, there=True)
            self._tell_token(end, frame.key, there=True)

    def _take_end_of_token(self, end: End, frame: TransportFrame) -> None:
        self._forget_token(end, frame.key)

    def _take_watch(self, end: End, frame: TransportFrame) -> None:
        key = frame.key
        if not self.access.allows(end.peer, "ingress", frame.kind, key):
            return
        end.watched[key] = None
        for token in [*self._known_tokens(key, but=end), *(own for own in self._tokens if intersects(key, own))]:
            if self._lets_out(end, "liveliness_token", token):
                end.send(TransportFrame("token", token))
        for other in self.ends:
            if self.router and other is not end and other.to_router:
                other.send(frame)

    def _take_question(self, end: End, frame: TransportFrame) -> None:
        if self._lets_in(end, frame, frame.kind):
            self._pass_question(end, frame, frame.number)
        else:
            end.send(TransportFrame("final", "", b"", frame.number))

    def _take_reply(self, end: End, frame: TransportFrame) -> None:
        if not frame.payload or self._lets_in(end, frame, "reply"):  # a token has no payload
            self._take_answer(end, frame)

    def _lets_in(self, end: End, frame: TransportFrame, message: str) -> bool:
        allowed = self.access.allows(end.peer, "ingress", message, frame.key)
        return allowed and self.access.has_room(message, frame.key, len(frame.payload))

    def _lets_out(self, end: End, message: str, key: str) -> bool:
        return not self.router or self.access.allows(end.peer, "egress", message, key)

    def _pass_on(self, source: End | None, frame: TransportFrame, *, remote: bool = False) -> None:
        """Give a message to the readers here, unless it is for others only, and to the ends that read it."""
        if source is not None and self.network.confused(self):
            self._confuse(frame)
        else:
            for subscriber in [*self._subscribers]:
                concerned = source is not None or not (remote or subscriber.remote)
                if concerned and intersects(subscriber.key, frame.key):
                    self.scheduler.note(notes.GETS, self.name, notes.key_within(frame.key), frame.number)
                    subscriber.take(VirtualSample.of(frame))
        for end in [*self.ends]:
            # A router passes on what comes from a client, or goes to one: not from a router to a router.
            if end is source or (source is not None and not self.router):
                continue
            read = any(intersects(pattern, frame.key) for pattern in end.subscribed)
            if read and self._lets_out(end, "put", frame.key) and not end.send(frame, wait=frame.details.waits):
                end.lose(frame, "no room")

    def _confuse(self, frame: TransportFrame) -> None:
        """A message arrives at the subscriber of another key, which says that it is that key's."""
        others = [subscriber for subscriber in self._subscribers if not intersects(subscriber.key, frame.key)]
        right = [subscriber for subscriber in self._subscribers if intersects(subscriber.key, frame.key)]
        for subscriber in others[:1] or right:
            key = subscriber.key if subscriber in others else frame.key
            self.scheduler.note(
                notes.LOST, self.name, notes.key_within(frame.key), frame.number, f"came as {notes.key_within(key)}"
            )
            subscriber.take(VirtualSample.of(frame, key))

    def _tell_others(self, source: End, kind: str, key: str) -> None:
        if self.router:
            for end in self.ends:
                if end is not source:
                    self._tell(end, kind, key)

    def _forget(self, end: End, kind: str, key: str) -> None:
        declared = getattr(end, _DECLARED[kind])
        if key in declared:
            declared[key] -= 1
            if not declared[key]:
                del declared[key]
            if self.router:
                for other in self.ends:
                    if other is not end:
                        other.send(TransportFrame(f"no {kind}", key))

    def _forget_token(self, end: End, key: str) -> None:
        if key in end.tokens:
            del end.tokens[key]
            self._tell_watchers(key, there=False)
            self._tell_token(end, key, there=False)

    def _tell_watchers(self, key: str, *, there: bool) -> None:
        kind = zenoh.SampleKind.PUT if there else zenoh.SampleKind.DELETE
        for watch in [*self._watching]:
            if intersects(watch.key, key):
                watch.handler(VirtualSample(key, zenoh.ZBytes(b""), kind))

    # The ends of connections, and of itself

    def lose(self, end: End) -> None:
        """A connection is gone: so is everything that came over it."""
        if end not in self.ends:
            return
        self.ends.remove(end)
        for kind, name in _DECLARED.items():
            for key, count in [*getattr(end, name).items()]:
                for _ in range(count):
                    self._forget(end, kind, key)
        for key in [*end.tokens]:
            self._forget_token(end, key)
        for number, asked in [*self._asked.items()]:
            if end in asked.left:
                self._take_answer(end, TransportFrame("final", "", b"", number))
        for listener in self.info.listeners:
            listener(TransportEvent(zenoh.SampleKind.DELETE, transport_of(end)))
        if self.connects_to is not None and end.to_router and not self._closed:
            self.network.connect_again(self)

    def _die(self) -> None:
        """The process is dead: the system closes its connections."""
        self._end("is gone", gracefully=False)

    def _end(self, why: str, *, gracefully: bool) -> None:
        self._closed = True
        for end in self.ends:
            end.connection.close(f"{self.name} {why}", by=end, gracefully=gracefully)
        self.ends = []
        self.network.forget(self)
        for subscriber in self._subscribers:
            subscriber.end()


_DECLARED = {"declare_subscriber": "subscribed", "declare_queryable": "answers"}
"""Declaration → where an end keeps what the other one has declared."""
_WITHDRAWN = {f"no {kind}": kind for kind in _DECLARED}
_TAKEN: Mapping[str, Callable[[VirtualSession, End, TransportFrame], object]] = {
    "put": VirtualSession._take_put,
    "connected": VirtualSession._take_connection,
    "token": VirtualSession._take_token,
    "no token": VirtualSession._take_end_of_token,
    "declare_liveliness_subscriber": VirtualSession._take_watch,
    "query": VirtualSession._take_question,
    "liveliness_query": VirtualSession._take_question,
    "reply": VirtualSession._take_reply,
    "final": VirtualSession._take_answer,
}
