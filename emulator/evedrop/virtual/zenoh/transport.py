"""A connection between two simulated sessions: frames arrive in order, later, or never; and what programs get of them.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, final

import zenoh

from evedrop.virtual import notes
from evedrop.virtual.scheduler import VirtualQueue, VirtualScheduler, VirtualTask, Waiter
from evedrop.virtual.zenoh.access import Access, Peer

_DELAY_SECONDS = 1e-4
"""The mean time of a frame on its way."""
_NOTICE_SECONDS = 5e-3
"""The mean time until an end notices that the other one is gone."""
_ROOM = 1 << 20
"""How many bytes are under way to one reader before its sender waits."""
_NO_BYTES = zenoh.ZBytes(b"")


class VirtualSample(NamedTuple):
    """A message as its reader gets it; on its way, what it carries besides its key and payload."""

    key_expr: str = ""
    payload: zenoh.ZBytes = _NO_BYTES
    kind: zenoh.SampleKind = zenoh.SampleKind.PUT
    encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES
    attachment: zenoh.ZBytes | None = None
    timestamp: zenoh.Timestamp | None = None
    source_info: zenoh.SourceInfo | None = None
    priority: zenoh.Priority = zenoh.Priority.DATA
    congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.BLOCK
    express: bool = False
    parameters: str = ""
    """Of a question."""

    @property
    def waits(self) -> bool:
        """Whether it waits for room, rather than to be dropped."""
        return self.congestion_control == zenoh.CongestionControl.BLOCK


PLAIN = VirtualSample()


def details_of(attachment: bytes | str | zenoh.ZBytes | None = None, **given: Any) -> VirtualSample:
    """What a message carries: what is given, but for None; the rest as it is by default."""
    details = {name: value for name, value in given.items() if value is not None and name in VirtualSample._fields}
    if attachment is not None:
        details["attachment"] = attachment if isinstance(attachment, zenoh.ZBytes) else zenoh.ZBytes(attachment)
    return VirtualSample(**details) if details else PLAIN


class TransportFrame(NamedTuple):
    """What one end sends to the other."""

    kind: str
    key: str
    payload: bytes = b""
    number: int = 0
    """Of the message, or of the question that it belongs to."""
    details: VirtualSample = PLAIN

    def sample(self, key: str | None = None) -> VirtualSample:
        """Its message; key: another one than its own."""
        return self.details._replace(key_expr=self.key if key is None else key, payload=zenoh.ZBytes(self.payload))


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


@dataclass(frozen=True)
class MatchingStatus:
    """Whether somebody reads what is published, or answers what is asked."""

    matching: bool


@dataclass(frozen=True)
class ReplyError:
    """What comes instead of an answer."""

    payload: zenoh.ZBytes
    encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES


@dataclass(frozen=True)
class Replier:
    """Who sent an answer."""

    eid: int


QUERYABLE = Replier(1)
"""A queryable. Zenoh's routing, which sends nothing here, is number 0."""


@dataclass(frozen=True)
class VirtualReply:
    """An answer to a question, or an error; without a replier that of the querier, whose time for answers is over."""

    ok: VirtualSample | None
    err: ReplyError | None = None
    replier_id: Replier | None = QUERYABLE


def bytes_of(payload: bytes | bytearray | str | zenoh.ZBytes | None) -> bytes:
    """The bytes of what a program puts."""
    if payload is None or isinstance(payload, bytes):
        return payload or b""
    if isinstance(payload, bytearray):
        return bytes(payload)
    return payload.encode() if isinstance(payload, str) else payload.to_bytes()


class AnySession(Protocol):
    """What the parts of a session use of it."""

    scheduler: VirtualScheduler
    task: VirtualTask
    name: str
    """Of its process."""
    router: bool
    """Whether it is a router's."""
    access: Access
    patience: float
    """Seconds that it waits for room before it closes a connection."""
    lease: float
    """Seconds without a word after which it takes the other end for gone."""
    inbox: VirtualQueue
    ends: list[End]

    def expect_open(self) -> None:
        """Raise ZError if it is closed."""

    def declare(self, kind: str, key: str) -> None:
        """Tell all ends of a declaration."""

    def withdraw(self, kind: str, key: str) -> None:
        """Tell all ends that a declaration is withdrawn."""

    def tokens_to_tell(self, key: str) -> list[str]:
        """The liveliness tokens that a question finds at it."""

    def lets_out(self, end: End, message: str, key: str) -> bool:
        """Whether a message may go out to an end."""


@final
class End:
    """One end of a connection, as its session sees it."""

    def __init__(self, session: AnySession, peer: Peer, to_router: bool) -> None:
        """peer: who is at the other end; to_router: whether that is a router."""
        self.session, self.peer, self.to_router = session, peer, to_router
        self.connection: VirtualConnection
        self.other: End
        self.subscribed: dict[str, int] = {}
        """Key expression that the other end reads → how many of its subscribers do."""
        self.answers: dict[str, int] = {}
        """Key expression at which the other end answers questions."""
        self.tokens: dict[str, None] = {}
        """Liveliness token of the other end, or of those behind it."""
        self.watched: dict[str, None] = {}
        """Liveliness tokens of which the other end wants to know."""
        self._bytes = 0
        """Under way to the other end, or not taken by it yet."""
        self._last = 0.0
        """When the latest frame arrives there."""
        self._full: deque[Waiter] = deque()
        self.until = -1.0
        """Until when frames of this end arrive although the connection is closed."""

    def send(self, frame: TransportFrame, *, wait: bool = True) -> bool:
        """Send a frame; returns whether it is on its way. wait: for room, rather than to drop it."""
        connection, scheduler = self.connection, self.session.scheduler
        size = len(frame.payload) + len(frame.key)
        deadline = scheduler.now + self.session.patience
        while connection.open and self._bytes and self._bytes + size > _ROOM:
            if not wait or scheduler.current is None:
                return False
            if scheduler.now >= deadline:
                connection.close(f"{self.session.name} has waited for room")
                break
            scheduler.wait(self._full, deadline - scheduler.now)
        if not connection.open:
            return False
        self._bytes += size
        self._last = max(self._last, connection.arrival())
        scheduler.at(self._last, lambda: self._arrive(frame, size))
        return True

    def _arrive(self, frame: TransportFrame, size: int) -> None:
        if not self.connection.open and self.session.scheduler.now > self.until:
            self.lose(frame, "the connection is closed")
            return
        if self.connection.held is not None:
            self.connection.held.append(lambda: self._arrive(frame, size))
            return
        self.other.session.inbox.put((self.other, frame, size))

    def lose(self, frame: TransportFrame, why: str) -> None:
        """Note that a message will never arrive at the other end."""
        if frame.kind == "put":
            self.session.scheduler.note(
                notes.LOST, self.other.session.name, notes.key_within(frame.key), frame.number, why
            )

    def taken(self, size: int) -> None:
        """The session at this end has dealt with a frame of this size."""
        sender = self.other
        sender._bytes -= size
        sender.session.scheduler.wake(sender._full)

    def leave(self, *, gracefully: bool) -> float:
        """Send no more; returns when the other end learns that. gracefully: everything that was sent arrives before."""
        scheduler = self.session.scheduler
        way = max(0.0, self._last - scheduler.now)
        self.until = scheduler.now + (way if gracefully else way * scheduler.random.random())
        return self.until

    def free(self) -> None:
        """Nobody waits for room any more."""
        self.session.scheduler.wake(self._full)


@final
class VirtualConnection:
    """Two ends, and what lies between them."""

    def __init__(self, scheduler: VirtualScheduler, client: End, router: End) -> None:
        self._scheduler, self.ends = scheduler, (client, router)
        client.other, router.other = router, client
        client.connection = router.connection = self
        self.open = True
        self.held: list[Callable[[], object]] | None = None
        """Frames that have come as far as where nothing gets through; None where everything does."""
        self._frozen_until = 0.0
        self._slow_until, self._factor = 0.0, 1.0

    def __str__(self) -> str:
        return f"{self.ends[0].session.name} – {self.ends[1].session.name}"

    def arrival(self) -> float:
        """When a frame that is sent now arrives."""
        scheduler = self._scheduler
        factor = self._factor if scheduler.now < self._slow_until else 1.0
        return scheduler.now + factor * scheduler.random.expovariate(1.0 / _DELAY_SECONDS)

    def close(self, why: str, by: End | None = None, *, gracefully: bool = False) -> None:
        """Close it: what is under way is lost, but for what the end that closes it has sent.

        by: that end, which knows it; all others notice. gracefully: all that it has sent arrives; otherwise some. Where nothing
        gets through, none of it does.
        """
        if not self.open:
            return
        frozen = self.held is not None
        self.open, self.held = False, None
        self._scheduler.note(notes.DISCONNECTS, self.ends[0].session.name, self.ends[1].session.name, why)
        begun = self._scheduler.now if by is None or frozen else by.leave(gracefully=gracefully)
        for end in self.ends:
            end.free()
            if end is not by:
                moment = begun + self._scheduler.random.expovariate(1.0 / _NOTICE_SECONDS)
                self._scheduler.at(moment, lambda end=end: end.session.inbox.put((end, None, 0)))  # type: ignore[misc]

    def freeze(self, seconds: float | None, *, noticed: bool = True) -> None:
        """Let nothing through for some time, or for good; after the shorter lease, both ends take the other one for gone.

        noticed: whether they do.
        """
        if self.held is None:
            self.held = []
        self._frozen_until = max(self._frozen_until, self._scheduler.later(seconds))
        self._scheduler.note(notes.FREEZES, self.ends[0].session.name, self.ends[1].session.name)
        lease = min(end.session.lease for end in self.ends)
        if noticed and (seconds is None or seconds >= lease):
            self._scheduler.after_seconds(lease, lambda: self.close("nothing came for the lease"))
        else:
            self._scheduler.after_seconds(seconds, self._thaw)

    def _thaw(self) -> None:
        if self._scheduler.now < self._frozen_until:  # it was frozen again meanwhile
            return
        held, self.held = self.held, None
        for arrive in held or ():
            arrive()

    def slow(self, factor: float, seconds: float | None) -> None:
        """Make everything take longer for some time, or for good."""
        self._factor, self._slow_until = factor, self._scheduler.later(seconds)
