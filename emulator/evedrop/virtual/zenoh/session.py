"""A simulated session of Zenoh: what a process declares, puts and gets, and what a router passes on.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from types import TracebackType
from typing import Any, Protocol, Self, final

import zenoh

from evedrop.virtual import notes
from evedrop.virtual.scheduler import VirtualQueue, VirtualScheduler, VirtualTask
from evedrop.virtual.zenoh.access import Access, expression_of, intersects, section
from evedrop.virtual.zenoh.certificates import shown_by
from evedrop.virtual.zenoh.handlers import (
    Callback,
    FifoChannel,
    RingChannel,
    Taker,
    VirtualDeclaration,
    items_of,
    taker_of,
)
from evedrop.virtual.zenoh.liveliness import Liveliness, VirtualWatch
from evedrop.virtual.zenoh.questions import (
    QUERY_SECONDS,
    VirtualQuerier,
    VirtualQuery,
    VirtualQueryable,
    VirtualQuestions,
)
from evedrop.virtual.zenoh.transport import (
    End,
    MatchingStatus,
    TransportEvent,
    TransportFrame,
    VirtualReply,
    VirtualSample,
    VirtualTransport,
    bytes_of,
    details_of,
)

_LEASE_MS = 10_000
_PATIENCE_US = 5_000_000
_USUAL_CHANNEL = FifoChannel(256)
_TOKENS_FIRST = 0.5
"""How often a router tells another one who is there before it tells what they read."""


@final
class VirtualSubscriber(VirtualDeclaration):
    """The messages of a key expression, as a channel keeps them or a function gets them."""

    def __init__(self, session: VirtualSession, key: str, taker: Taker, remote: bool = False) -> None:
        """remote: whether messages of its own session are none of its business."""
        self._session, self.key, self.taker, self.remote = session, key, taker, remote

    @property
    def handler(self) -> Any:
        """What keeps its messages."""
        return self.taker

    def recv(self) -> VirtualSample:
        """Wait for the next message. Raises ZError once it is undeclared and all are read."""
        sample: VirtualSample = self.handler.recv()
        return sample

    def try_recv(self) -> VirtualSample | None:
        """The next message, if there is one. Raises ZError once it is undeclared and all are read."""
        sample: VirtualSample | None = self.handler.try_recv()
        return sample

    def __iter__(self) -> Iterator[VirtualSample]:
        """The messages, until it is undeclared."""
        return items_of(self.handler)

    def undeclare(self) -> None:
        """End it: what has arrived can still be read."""
        self.taker.end()
        self._session.end_subscription(self)


@final
class VirtualPublisher(VirtualDeclaration):
    """Puts messages on a key."""

    def __init__(self, session: VirtualSession, key: str, how: Mapping[str, Any]) -> None:
        """how: as for `VirtualSession.put`."""
        self._session, self._key, self._how = session, key, how

    def put(self, payload: bytes | str | zenoh.ZBytes, **details: Any) -> None:
        """Put a message. Raises ZError if the session is closed."""
        self._session.put(self._key, payload, **self._how, **details)

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether somebody reads the key. Raises ZError if the session is closed."""
        remote = self._how.get("allowed_destination") == zenoh.Locality.REMOTE
        return MatchingStatus(self._session.has_reader(self._key, remote=remote))


@final
@dataclass
class Info:
    """The identity and connections of a session."""

    session: VirtualSession
    listeners: list[Taker] = field(default_factory=list)

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
        self.session.expect_open()
        taker = taker_of(self.session, listener)
        for end in self.session.ends if history else ():
            taker.put(TransportEvent(zenoh.SampleKind.PUT, transport_of(end)))
        self.listeners.append(taker)

    declare_link_events_listener = declare_transport_events_listener

    def tell(self, kind: zenoh.SampleKind, end: End) -> None:
        """A connection is made or lost."""
        for listener in self.listeners:
            listener.put(TransportEvent(kind, transport_of(end)))


def transport_of(end: End) -> VirtualTransport:
    """A connection, as one of its ends sees it."""
    other = zenoh.WhatAmI.PEER if end.peer.is_peer else zenoh.WhatAmI.CLIENT
    what = zenoh.WhatAmI.ROUTER if end.to_router else other
    return VirtualTransport(end.peer.zid, what, end.peer.user, f"tcp/{end.peer.zid}")


class Network(Protocol):
    """The part of the network that its sessions use."""

    scheduler: VirtualScheduler

    def confused(self, session: VirtualSession) -> bool:
        """Whether the message that a session gets now is to arrive at the wrong subscriber."""

    def changed(self, session: VirtualSession, message: bytes) -> bytes:
        """What arrives at a session of a message."""

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
        self.router, self.peer = (section(config, "mode") == mode for mode in ("router", "peer"))
        self.answers_scouts = self.peer and section(config, "scouting/multicast/enabled") is not False
        self.access, self.certificate = Access(config), shown_by(config)
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
        self.questions = VirtualQuestions(self)
        self._liveliness = Liveliness(self.questions)
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
        return self._liveliness

    def declare_subscriber(
        self,
        key: str | zenoh.KeyExpr,
        handler: FifoChannel | RingChannel | Callable[[VirtualSample], object] = _USUAL_CHANNEL,
        *,
        allowed_origin: zenoh.Locality = zenoh.Locality.ANY,
    ) -> VirtualSubscriber:
        """Read a key expression. Raises ZError if the session is closed, and TypeError for a handler of another kind."""
        self.expect_open()
        if not (isinstance(handler, FifoChannel | RingChannel) or callable(handler)):
            raise TypeError(f"{handler!r} is not simulated; expected a function, or a FifoChannel or RingChannel")
        remote = allowed_origin == zenoh.Locality.REMOTE
        subscriber = VirtualSubscriber(self, expression_of(key), taker_of(self, handler), remote)
        self._subscribers.append(subscriber)
        self.declare("declare_subscriber", subscriber.key)
        return subscriber

    def end_subscription(self, subscriber: VirtualSubscriber) -> None:
        """End a subscription."""
        if subscriber in self._subscribers:
            self._subscribers.remove(subscriber)
            self.withdraw("declare_subscriber", subscriber.key)

    def declare_publisher(
        self,
        key: str,
        congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.DROP,
        **how: Any,
    ) -> VirtualPublisher:
        """Publish on a key; how: as for `put`. Raises ZError if the session is closed."""
        self.expect_open()
        return VirtualPublisher(self, expression_of(key), {**how, "congestion_control": congestion_control})

    def declare_queryable(
        self, key: str | zenoh.KeyExpr, handler: Callable[[VirtualQuery], object], **_: object
    ) -> VirtualQueryable:
        """Answer questions at a key expression. Raises ZError if the session is closed."""
        return self.questions.declare_queryable(expression_of(key), handler)

    def declare_querier(
        self,
        key: str,
        timeout: float = QUERY_SECONDS,
        *,
        consolidation: zenoh.ConsolidationMode = zenoh.ConsolidationMode.AUTO,
        **_: object,
    ) -> VirtualQuerier:
        """Ask others at a key expression. Raises ZError if the session is closed."""
        self.expect_open()
        return VirtualQuerier(
            self.questions, expression_of(key), timeout, consolidation != zenoh.ConsolidationMode.NONE
        )

    def put(
        self,
        key: str,
        payload: bytes | str | zenoh.ZBytes,
        *,
        allowed_destination: zenoh.Locality = zenoh.Locality.ANY,
        congestion_control: zenoh.CongestionControl | None = None,
        **details: Any,
    ) -> None:
        """Put a message on a key; details: as of a `VirtualSample`. Raises ZError if the session is closed."""
        control = zenoh.CongestionControl.DROP if congestion_control is None else congestion_control
        self.expect_open()
        self.task.allocate()
        message = bytes_of(payload)
        self.scheduler.note(notes.PUT, notes.key_within(expression_of(key)), len(message), notes.said_in(message))
        sent = details_of(congestion_control=control, **details)
        frame = TransportFrame("put", str(key), message, self.scheduler.events, sent)
        self._pass_on(None, frame, remote=allowed_destination == zenoh.Locality.REMOTE)
        self.scheduler.interruptible()

    def delete(self, key: str, **how: Any) -> None:
        """Delete what is on a key. Raises ZError if the session is closed."""
        self.put(key, b"", kind=zenoh.SampleKind.DELETE, **how)

    def get(
        self, key: str, handler: Callback | None = None, *, payload: bytes = b"", timeout: float = QUERY_SECONDS
    ) -> Iterator[VirtualReply] | None:
        """Ask a question, and return the latest answer of each key, unless a handler gets them. Raises ZError if closed."""
        selected, _, parameters = str(key).partition("?")
        frame = TransportFrame(
            "query", expression_of(selected), bytes_of(payload), details=details_of(parameters=parameters or None)
        )
        return self.questions.ask(frame, timeout, handler, latest=True)

    def has_reader(self, key: str, *, remote: bool = False) -> bool:
        """Whether somebody reads a key; remote: somebody else. Raises ZError if the session is closed."""
        self.expect_open()
        own = () if remote else (subscriber.key for subscriber in self._subscribers)
        others = (pattern for end in self.ends for pattern in end.subscribed)
        return any(intersects(pattern, key) for pattern in chain(own, others))

    # Declarations

    def declare(self, kind: str, key: str) -> None:
        """Tell all ends of a declaration."""
        for end in self.ends:
            self._tell(end, kind, key)
        self.scheduler.interruptible()

    def withdraw(self, kind: str, key: str) -> None:
        """Tell all ends that a declaration is withdrawn."""
        for end in self.ends:
            end.send(TransportFrame(f"no {kind}", key))

    def _tell(self, end: End, kind: str, key: str) -> None:
        if self.lets_out(end, kind, key):
            end.send(TransportFrame(kind, key))

    def greet(self, end: End) -> None:
        """Tell a new end everything that is declared here, and, from a router, what others have declared.

        Another router may learn who is there before it learns what they read.
        """
        others = [other for other in self.ends if other is not end and self.router]
        tokens_first = self.router and end.to_router and self.scheduler.random.random() < _TOKENS_FIRST
        if tokens_first:
            self._liveliness.greet(end, others)
        for subscriber in self._subscribers:
            self._tell(end, "declare_subscriber", subscriber.key)
        for queryable in self.questions.answering:
            self._tell(end, "declare_queryable", queryable.key)
        for other in others:
            for kind, name in _DECLARED.items():
                for key, times in getattr(other, name).items():
                    for _ in range(times):  # an old connection's, too, whose end is passed on
                        self._tell(end, kind, key)
        if not tokens_first:
            self._liveliness.greet(end, others)
        if self.info.listeners:
            self.inbox.put((end, TransportFrame("connected", ""), 0))

    def tokens_to_tell(self, key: str) -> list[str]:
        """The liveliness tokens that a question finds here."""
        return self._liveliness.to_tell(key)

    # What arrives

    def _receive(self) -> None:
        """Deal with frames one after the other, as Zenoh's receiving thread does."""
        while (item := self.inbox.get()) is not None:
            end, frame, size = item
            if frame is None:
                self.lose(end)
                continue
            if end in self.ends:
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

    def _take_question(self, end: End, frame: TransportFrame) -> None:
        if self._lets_in(end, frame, frame.kind):
            self.questions.pass_from(end, frame)
        else:
            end.send(TransportFrame("final", "", b"", frame.number))

    def _take_reply(self, end: End, frame: TransportFrame) -> None:
        if not frame.payload or self._lets_in(end, frame, "reply"):  # a token and the last word have no payload
            self.questions.take(end, frame)

    def _lets_in(self, end: End, frame: TransportFrame, message: str) -> bool:
        allowed = self.access.allows(end.peer, "ingress", message, frame.key)
        return allowed and self.access.has_room(message, frame.key, len(frame.payload))

    def lets_out(self, end: End, message: str, key: str) -> bool:
        """Whether a message may go out to an end."""
        return not self.router or self.access.allows(end.peer, "egress", message, key)

    def _pass_on(self, source: End | None, frame: TransportFrame, *, remote: bool = False) -> None:
        """Give a message to the readers here, unless it is for others only, and to the ends that read it."""
        if source is not None:
            frame = frame._replace(payload=self.network.changed(self, frame.payload))
        if source is not None and self.network.confused(self):
            self._confuse(frame)
        else:
            for subscriber in [*self._subscribers]:
                concerned = source is not None or not (remote or subscriber.remote)
                if concerned and intersects(subscriber.key, frame.key):
                    self.scheduler.note(notes.GETS, self.name, notes.key_within(frame.key), frame.number)
                    subscriber.taker.put(frame.sample())
        for end in [*self.ends]:
            # A router passes on what comes from a client, or goes to one: not from a router to a router.
            if end is source or (source is not None and not self.router):
                continue
            read = frame.key in end.subscribed or any(intersects(pattern, frame.key) for pattern in end.subscribed)
            if read and self.lets_out(end, "put", frame.key) and not end.send(frame, wait=frame.details.waits):
                end.lose(frame, notes.NO_ROOM)

    def _confuse(self, frame: TransportFrame) -> None:
        """A message arrives at the subscriber of another key, which says that it is that key's."""
        others = [subscriber for subscriber in self._subscribers if not intersects(subscriber.key, frame.key)]
        right = [subscriber for subscriber in self._subscribers if intersects(subscriber.key, frame.key)]
        for subscriber in others[:1] or right:
            key = subscriber.key if subscriber in others else frame.key
            self.scheduler.note(
                notes.LOST, self.name, notes.key_within(frame.key), frame.number, notes.came_as(notes.key_within(key))
            )
            subscriber.taker.put(frame.sample(key))

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
        self._liveliness.lose(end)
        self.questions.lose(end)
        self.info.tell(zenoh.SampleKind.DELETE, end)
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
        self.questions.end()
        handled: list[VirtualSubscriber | VirtualWatch] = [*self._subscribers, *self._liveliness.watching]
        for taker in (*(each.taker for each in handled), *self.info.listeners):
            taker.end()


_DECLARED = {"declare_subscriber": "subscribed", "declare_queryable": "answers"}
"""Declaration → where an end keeps what the other one has declared."""
_WITHDRAWN = {f"no {kind}": kind for kind in _DECLARED}
_TAKEN: Mapping[str, Callable[[VirtualSession, End, TransportFrame], object]] = {
    "put": VirtualSession._take_put,
    "connected": lambda session, end, _: session.info.tell(zenoh.SampleKind.PUT, end),
    **dict.fromkeys(
        ("token", "no token", "declare_liveliness_subscriber"),
        lambda session, end, frame: session._liveliness.take(end, frame),
    ),
    **dict.fromkeys(("query", "liveliness_query"), VirtualSession._take_question),
    **dict.fromkeys(("reply", "error", "final"), VirtualSession._take_reply),
}
