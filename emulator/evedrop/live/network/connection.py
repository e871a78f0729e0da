"""A process's connection with its router: one Zenoh session after another, each with everything the process has declared.

Zenoh would reconnect a session by itself, but then may deliver one key's messages to another key's subscriber
(docs/maintainers/tests.md). So a session that has lost its router is closed and another one is opened, which holds nothing that
could be out of date. The process keeps one object for each publisher, subscription or other entity that it declares: it reads a
subscription without a break while another subscriber replaces the subscription's own.

A process that has had no connection for too long ends itself: the recorder cannot tell it to end. So does one that was started
by hand if it is the recorder that is gone. While it is on its network it
touches a file whose age is a cheap health check, if the environment names one, as the image of docs/containers.md does.

Source: docs/protocol.md, lost connections.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol, TypeVar, final

import zenoh

from evedrop.errors import EvedropError, RunError
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Dropped, head_of
from evedrop.live.protocol.commands import StatusReporter
from evedrop.live.protocol.last_word import Cause, LastWord
from evedrop.system.output import say
from evedrop.system.threads import Queue, Thread
from evedrop.system.waiting import Alarm
from evedrop.system.world import world


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
        """status: of the process, which records there that it waits; room: how many messages it holds, the latest ones.

        It forgets older ones rather than keep Zenoh's thread, which brings the messages of all keys, from going on: a process
        that waits for another key, or that has ended its work, does not read it.
        """
        self._room = room
        self._key, self._head, self._dropped, self._status = key, head_of(key), dropped, status
        self._waits = (key,)
        self._subscribers: Queue[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None] = world().queue()
        self._subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe. What has arrived on the previous session, and is not read, is lost with it."""
        self._subscribers.put(session.declare_subscriber(self._key, world().zenoh.handlers.RingChannel(self._room)))

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
        messages = [self.recv()]
        while len(messages) < most and self._subscriber is not None:
            try:
                sample = self._subscriber.try_recv()
            except zenoh.ZError:  # as for `recv`, which continues with the next session
                break
            if sample is None:
                break
            payload = self._dropped.contents(self._key, self._head, sample.payload.to_bytes())
            if payload is not None:
                messages.append(payload)
        return messages

    def _received(self) -> bytes:
        while True:
            if self._subscriber is None:
                self._subscriber = self._subscribers.get()
                if self._subscriber is None:
                    raise SubscriptionClosedError(self._key)
            try:
                message = self._subscriber.recv().payload.to_bytes()
            except zenoh.ZError:  # its session is closed
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


FULL_SECONDS = 2.5
"""For which a message waits for a reader that takes none; then Zenoh closes the reader's connection.

Meanwhile Zenoh may send nothing to all others, who would take this process for gone if it lasted as long as their lease.
"""


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
        begun = world().monotonic()
        try:
            publisher.put(self._head + payload)
        except zenoh.ZError:
            if not session.is_closed():
                raise
        if world().monotonic() - begun > 0.8 * FULL_SECONDS:
            world().sleep(_CLOSING_SECONDS)  # Zenoh cannot close the connection while another message waits

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
        self._lock = world().lock()
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


_AGAIN_SECONDS = 0.02, 0.25  # between attempts, the first and the longest
_ANSWER_SECONDS = 1.0
_RENEW_SECONDS = 1.0  # between sessions that are closed because they confuse keys
_POLL_SECONDS = 0.02
_CLOSING_SECONDS = 0.2
_LINGER_SECONDS = 10.0  # longer than a router needs to find out that a connection is lost

One = TypeVar("One", bound=Declared)


@final
class Connection:
    """A connection that survives the loss of a session; thread-safe; close it, or its threads outlive the program.

    first: the open session. again: makes one attempt to open another; None for a router, to which the others connect.
    changed: called with false at each loss, with true at each new session, on a thread of the connection's.
    """

    def __init__(
        self,
        first: zenoh.Session,
        again: Callable[[], zenoh.Session] | None,
        changed: Callable[[bool], None] = lambda _: None,
    ) -> None:
        self._again, self._changed = again, changed
        self._lock = world().rlock()
        self._declared: list[Declared] = []
        self._token_key: str | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._losses: Queue[zenoh.Session | None] = world().queue()
        self._over = world().event()
        self._keeper: Thread | None = None
        self.session = first
        """The current session, which is closed while another one is opened."""
        self._opened = world().monotonic()
        self.openings = 1
        """How many sessions there have been."""
        if again is not None:
            self._listen(first)
            self._keeper = world().thread(self._keep_open, name="keeps-open")
            self._keeper.start()

    def declare(self, declaration: One) -> One:
        """Declare an object, now and on every later session."""
        with self._lock:
            self._declared.append(declaration)
            self._declare(self.session, declaration)
        return declaration

    def appear(self, key: str) -> None:
        """Show that this process is present, now and on every later session."""
        with self._lock:
            self._token_key = key
            self._show(self.session)

    def disappear(self) -> None:
        """Withdraw the token that `appear` declared."""
        with self._lock:
            self._token_key = None
            if self._token is not None and not self.session.is_closed():
                with suppress(zenoh.ZError):
                    self._token.undeclare()

    def renew(self) -> None:
        """Open another session, since this one confuses keys; at most once per second."""
        if self._again is not None and world().monotonic() - self._opened > _RENEW_SECONDS:
            self._losses.put(self.session)

    def close(self) -> None:
        """Close the connection for good."""
        self._over.set()
        self._losses.put(None)
        if self._keeper is not None:
            with suppress(RuntimeError):  # this is its thread
                self._keeper.join(_LINGER_SECONDS)  # it may be opening a session that nobody needs any more
        _close(self.session)
        for declaration in self._declared:
            if isinstance(declaration, Subscription):
                declaration.close()

    def _declare(self, session: zenoh.Session, declaration: Declared) -> None:
        """Declare an object on a session that may be closed already: the next session will have it, too."""
        try:
            declaration.declare(session)
        except zenoh.ZError:
            if not session.is_closed():
                raise

    def _show(self, session: zenoh.Session) -> None:
        if self._token_key is not None and not session.is_closed():
            with suppress(zenoh.ZError):
                self._token = session.liveliness().declare_token(self._token_key)

    def _listen(self, session: zenoh.Session) -> None:
        """Notice when the session loses its router. Closing it here, on a thread of Zenoh's, would deadlock."""
        session.info.declare_transport_events_listener(
            lambda event: self._losses.put(session) if event.kind == zenoh.SampleKind.DELETE else None
        )
        if not session.info.routers_zid():  # lost before there was a listener
            self._losses.put(session)

    def _keep_open(self) -> None:
        while (lost := self._losses.get()) is not None:
            if lost is self.session and not self._over.is_set():
                self._replace(lost)

    def _replace(self, lost: zenoh.Session) -> None:
        self._changed(False)
        for declaration in list(self._declared):
            if isinstance(declaration, Watch):
                declaration.lose()
        _close(lost)
        pause, longest = _AGAIN_SECONDS
        while not self._over.is_set() and self._again is not None:
            try:
                session = self._again()
            except (EvedropError, OSError, zenoh.ZError):
                self._over.wait(pause)
                pause = min(longest, pause * 1.5)
                continue
            self._adopt(session)
            return

    def _adopt(self, session: zenoh.Session) -> None:
        """Declare everything on another session, in the same order; the token of this process comes last."""
        with self._lock:
            self.session, self._opened = session, world().monotonic()
            self.openings += 1
            self._listen(session)
            for declaration in self._declared:
                self._declare(session, declaration)
            key = self._token_key
        self._changed(True)
        if key is not None:
            self._wait_for_own_end(session, key)
        with self._lock:
            self._show(session)

    def _wait_for_own_end(self, session: zenoh.Session, key: str) -> None:
        """Wait until the router knows that the previous session is lost: others must see this process leave and return.

        The router may find out later than this process: until then it has the previous token, and a new one would not show.
        """
        deadline = world().monotonic() + _LINGER_SECONDS
        with suppress(zenoh.ZError):
            while (
                not self._over.is_set()
                and session.info.routers_zid()
                and world().monotonic() < deadline
                and any(answer.ok is not None for answer in session.liveliness().get(key, timeout=_ANSWER_SECONDS))
            ):
                world().sleep(_POLL_SECONDS)


def _close(session: zenoh.Session) -> None:
    """Close a session. If its router is stopped, Zenoh gives up after ten seconds; the session is of no use then either."""
    with suppress(zenoh.ZError):
        session.close()


@final
class ConnectionWatchdog:
    """Ends its process after `flow.longest_outage` without a connection."""

    def __init__(self, brief: AnyBrief) -> None:
        self._brief = brief
        self._alarm = Alarm(self._give_up)
        self._released = False

    def changed(self, connected: bool) -> None:
        """Handle the loss or the return of the connection."""
        self._alarm.set(None if connected or self._released else self._brief.flow.longest_outage)

    def release(self) -> None:
        """Stop watching: the process closes its connection itself."""
        self._released = True
        self._alarm.set(None)

    def _give_up(self) -> None:
        sentence = (
            f"{self._brief.process} has had no connection with the router at {self._brief.router} for "
            f"{self._brief.flow.longest_outage:g} s; check that the router runs and can be reached"
        )
        say(sentence)
        sys.stderr.flush()
        LastWord(Cause.NO_CONNECTION, sentence).leave(self._brief.last_word)
        world().process.exit(RunError.exit_status)


_STEP_SECONDS = 0.25


@final
class RecorderWatchdog:
    """Ends a process that was started by hand if its recorder does not come, or is gone for `flow.longest_outage`.

    Time in which the process was suspended hardly counts: it waits in steps.
    """

    def __init__(self, brief: AnyBrief, linked: Callable[[], bool]) -> None:
        """linked: whether the process is on its network, and would see the recorder."""
        self._brief, self._linked = brief, linked
        self._over = world().event()

    def start(self, reached: Callable[[], bool], patience: float) -> None:
        """Begin to watch. reached: whether the recorder is there; patience: how many seconds to wait until it is."""
        world().thread(self._watch, reached, patience, name="recorder watchdog").start()

    def release(self) -> None:
        """Stop watching: the recorder has ended the run."""
        self._over.set()

    def _watch(self, reached: Callable[[], bool], patience: float) -> None:
        steps, limit, why = 0, patience, f"did not appear within {patience:g} s; start it, or look at its log"
        while (steps - 1) * _STEP_SECONDS <= limit:  # of the first step it is not known how much it was gone
            if self._over.wait(_STEP_SECONDS):
                return
            if reached():
                steps, limit = 0, self._brief.flow.longest_outage
                why = f"has been gone for {limit:g} s; look at its log"
            elif self._linked():
                steps += 1
        say(f"{self._brief.process}: the recorder {why}")
        sys.stderr.flush()
        world().process.exit(RunError.exit_status)


VARIABLE = "EVEDROP_HEARTBEAT"
_BEAT_SECONDS = 2.0


@final
class HeartbeatFile:
    """Touches the file that the environment names, if it names one, until `stop`."""

    def __init__(self, connected: Callable[[], bool]) -> None:
        """connected: whether the process is on its network."""
        self._connected = connected
        self._over = world().event()
        self._thread: Thread | None = None

    def start(self) -> None:
        """Start to touch the file. Does nothing if already started."""
        path = os.environ.get(VARIABLE)
        if path and self._thread is None:
            self._thread = world().thread(self._keep, Path(path), name="heartbeat")
            self._thread.start()

    def stop(self) -> None:
        """Stop touching the file and checking the connection."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_BEAT_SECONDS)

    def _keep(self, path: Path) -> None:
        while not self._over.is_set():
            if self._connected():
                with suppress(OSError):  # the process then counts as unhealthy, but continues
                    path.touch()
            self._over.wait(_BEAT_SECONDS)
