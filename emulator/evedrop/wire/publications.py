"""Publications that cross: what programs put and delete at one side goes to the other sides, as the links between them decide.

At a side, a key that comes often has a publisher; all others do without one. Payloads stay in Zenoh's memory: nothing here copies
one into Python.

Source: docs/wire/semantics.md, messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, final

import zenoh

from evedrop.system.waiting import wait_for_thread
from evedrop.system.world import world
from evedrop.wire.departures import Backlog
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import AGAIN, HELD, UNLINKED, Kind, WireFate
from evedrop.wire.ros2 import SenderReader
from evedrop.wire.running_link import Lane, RunningLink
from evedrop.wire.send_queue import LONG_SECONDS, SendQueue, waiting_bytes
from evedrop.wire.side import SideSession, expressions_in_turn
from evedrop.wire.watchdog import Duty

WAITING = 8192
"""Messages of a side that may wait for the wire; then the side's programs wait, or Zenoh drops, as each message says."""
READY_KEYS = 8192
"""Keys that a subscription keeps everything ready for; a key takes some 5 kB."""
_DROP = zenoh.CongestionControl.DROP


@final
class _Way:
    """The way of a key's messages over one link. Only the thread that takes the key's messages uses it."""

    __slots__ = (
        "_count",
        "_key",
        "_last",
        "_publishers",
        "_session",
        "_state",
        "alone",
        "decide",
        "link",
        "order",
        "patient",
        "send_queue",
        "used",
    )  # fmt: skip

    def __init__(
        self, state: RunningLink, key: str, publishers: Publishers, send_queue: SendQueue, decide: Lane, only: bool
    ) -> None:
        """only: whether all links from its side lead to the same other side, apart from taps."""
        self.decide = decide
        self.link = state.link.number
        self.send_queue = send_queue
        self.patient = not state.link.tap
        """Whether its messages wait for room at the other side."""
        self.order = state.order("put", key)
        self.alone = only and self.patient
        """Whether all links from its side lead to the same other side, so that no third side waits with its messages."""
        self.used = False
        """Whether a further message came since this was last set to False."""
        self._key, self._publishers, self._session, self._state = key, publishers, publishers.session, state
        self._count = 0
        self._last: tuple[zenoh.Publisher, Any, Any, bool] | None = None

    def forget(self) -> None:
        """Release the resources of the key; its next message gets the next fate all the same."""
        self._state.forget("put", self._key)
        self._release()

    def drops(self, sample: zenoh.Sample) -> bool:
        """Whether Zenoh drops a message at a reader that is slow, and lets nobody wait long: always copies over a tap."""
        return not self.patient or sample.congestion_control == _DROP

    def message(
        self, sample: zenoh.Sample, copies: int, publisher: zenoh.Publisher | None = None
    ) -> Callable[[], object]:
        """What sends a message."""
        if publisher is None:
            congestion = sample.congestion_control if self.patient else _DROP
            return partial(publish, self._session, sample, congestion, copies)
        return partial(
            publisher.put,
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            timestamp=sample.timestamp,
            source_info=sample.source_info,
        )

    def publisher(self, sample: zenoh.Sample) -> zenoh.Publisher | None:
        """The publisher for a message; None for the first messages of a key, and where there are too many publishers.

        Raises zenoh.ZError.
        """
        last = self._last
        if last is None:
            self._count += 1
            if self._count <= OFTEN:
                return None
            self._count = 0  # if there are too many, ask again after as many messages
            publisher = self._publishers.declare(sample, sample.congestion_control if self.patient else _DROP)
            if publisher is not None:
                self._last = (publisher, sample.priority, sample.congestion_control, sample.express)
            return publisher
        if last[1] == sample.priority and last[2] == sample.congestion_control and last[3] == sample.express:
            return last[0]
        self._release()
        return None

    def _release(self) -> None:
        """Undeclare the publisher after the messages that still wait for their turn with it."""
        if self._last is not None:
            self.send_queue.follow(partial(self._publishers.release, self._last[0]))
            self._last = None


_Ways = tuple[tuple[_Way, ...], int]
"""The ways of a key, and its code in the journal."""


@final
class PublicationRelay:
    """Takes the publications of a side from Zenoh, and gives them to the other sides."""

    def __init__(
        self,
        side: SideSession,
        links: Mapping[str, RunningLink],
        publishers: Mapping[str, Publishers],
        send_queues: Mapping[str, SendQueue],
        plan: WirePlan,
        journal: WireJournal,
        fail: Callable[[str], None],
    ) -> None:
        """links, publishers, send_queues: by the names of links and of sides; fail: is told why messages no longer cross."""
        self._links, self._publishers, self._send_queues = links, publishers, send_queues
        self._plan, self._journal = plan, journal
        links_away = [link for link in plan.links if link.source == side.name]
        self._targets = [name for name in publishers if name in {link.target for link in links_away}]
        self._has_one_target = len({link.target for link in links_away if not link.tap}) == 1
        self._side, self._name, self._fail = side, side.name, fail
        self.duties: list[Duty] = []
        self.backlogs: list[Backlog] = []
        """The messages of each subscription that wait for the wire."""
        self._until = math.inf
        self._subscribers = []
        self._threads = []
        for expression, earlier in expressions_in_turn(side.side, plan.links):
            channel: zenoh.handlers.FifoChannel[zenoh.Sample] = world().zenoh.handlers.FifoChannel(WAITING)
            subscriber = side.session.declare_subscriber(expression, channel, allowed_origin=REMOTE)
            self._subscribers.append(subscriber)
            self.duties.append(Duty(f"among the messages from the side {side.name}"))
            self.backlogs.append(Backlog(subscriber.handler, WAITING))
            arguments = (self.backlogs[-1], earlier, self.duties[-1])
            self._threads.append(world().thread(self._run, *arguments, name=f"from {side.name}"))

    def start(self) -> None:
        """Begin to take messages."""
        for thread in self._threads:
            thread.start()

    def leave(self, until: float) -> None:
        """Let messages that wait after a time of the monotonic clock be underway: to take them all may last too long."""
        self._until = until

    def close(self) -> None:
        """End; messages that Zenoh has already handed over still cross, or are underway as `leave` says."""
        with self._side.duty.busy():
            for subscriber in self._subscribers:
                subscriber.undeclare()
        for thread in self._threads:
            wait_for_thread(thread)

    def _run(self, backlog: Backlog, earlier: tuple[zenoh.KeyExpr, ...], duty: Duty) -> None:
        try:
            self._take_all(backlog, earlier, duty)
        except Exception as error:  # whatever it is: nothing may silently stop crossing
            self._fail(f"messages from the side {self._name} no longer cross ({error!r}); end the wire and report this")

    def _take_all(self, backlog: Backlog, earlier: tuple[zenoh.KeyExpr, ...], duty: Duty) -> None:
        take = self._taker()

        def take_own(sample: zenoh.Sample) -> None:
            if not any(expression.intersects(sample.key_expr) for expression in earlier):
                take(sample)

        backlog.take_all(take_own if earlier else take, duty)

    def _taker(self) -> Callable[[zenoh.Sample], None]:
        """The function that is called for every message: it looks up as little as possible."""
        ways_of: dict[str, _Ways] = {}
        ahead, clock, way_to = self._journal.place.clock.ahead, world().monotonic, self._way_to
        records = self._journal.records
        record, amend, sent = records.record, records.amend, records.sent
        read = SenderReader(self._journal.words.source_code)
        put, put_kind, delete_kind = zenoh.SampleKind.PUT, int(Kind.PUT), int(Kind.DELETE)
        unlinked, underway, zenoh_error = int(WireFate.UNLINKED), int(WireFate.UNDERWAY), zenoh.ZError
        refused = WireFate.REFUSED

        def take(sample: zenoh.Sample) -> None:
            since = clock()
            key = str(sample.key_expr)
            ready = ways_of.get(key)
            ways, code = way_to(ways_of, key, sample.key_expr) if ready is None else ready
            payload, attachment, source = sample.payload, sample.attachment, sample.source_info
            size = len(payload)
            sender, sequence = 0, -1
            if attachment is not None:
                size += len(attachment)
                sender, sequence = read(attachment, source)
            elif source is not None:
                sender, sequence = read(None, source)
            is_put = sample.kind == put
            kind = put_kind if is_put else delete_kind
            if not ways:
                record(ahead + since, -1, sequence, 0.0, code, sender, size, UNLINKED, kind, unlinked)
            for way in ways:
                way.used = ready is not None
                n, fate, delay, again = way.decide(since, size)
                if since > self._until and not fate:
                    fate, delay, again = underway, 0.0, False
                send_queue = way.send_queue
                at_once = not delay and way.order is None and send_queue.is_free and (way.alone or way.drops(sample))
                row = record(
                    ahead + since,
                    n,
                    sequence,
                    delay,
                    code,
                    sender,
                    size,
                    way.link,
                    kind | AGAIN if again else kind,
                    fate or HELD,
                )
                if fate:
                    continue
                try:
                    frequent = is_put and not (delay or again or way.order)
                    publisher = way.publisher(sample) if frequent else None
                    message = way.message(sample, 2 if again else 1, publisher)
                    if not at_once:
                        room = waiting_bytes(size, key)
                        send_queue.send(delay, room, row, message, patient=way.patient, order=way.order, since=since)
                        continue
                    begun = clock()
                    message()
                    sent(row)
                    if clock() - begun > LONG_SECONDS:
                        send_queue.took(clock() - begun, way.alone)
                except zenoh_error:
                    amend(row, refused)

        return take

    def _way_to(self, ways_of: dict[str, _Ways], key: str, expression: zenoh.KeyExpr) -> _Ways:
        """The ways of a key that is heard for the first time, or again after many other keys, and its code."""
        while len(ways_of) >= READY_KEYS:
            oldest = next(iter(ways_of))
            ready = ways_of.pop(oldest)
            if any(way.used for way in ready[0]):
                for way in ready[0]:
                    way.used = False
                ways_of[oldest] = ready  # now the newest
            else:
                for way in ready[0]:
                    way.forget()
        code = self._journal.words.key_code(key, self._name)
        taken = [self._plan.link_of(self._name, target, expression) for target in self._targets]
        states = [self._links[link.name] for link in taken if link is not None]
        ended = world().monotonic() > self._until
        if code and not ended:
            lossless = self._plan.is_lossless(expression)
            decisions = [state.lane("put", key, lossless) for state in states]
        else:
            decisions = [_UNDERWAY if code else _TOO_MANY_KEYS] * len(states)
        ways = tuple(
            _Way(
                state,
                key,
                self._publishers[state.link.target],
                self._send_queues[state.link.target],
                decide,
                self._has_one_target,
            )
            for state, decide in zip(states, decisions, strict=True)
        )
        if code and not ended:
            ways_of[key] = (ways, code)
        return ways, code


def _undecided(fate: WireFate) -> Lane:
    """The lane of messages with a fate that is not the link's, which get no numbers."""
    return lambda _now, _size: (-1, int(fate), 0.0, False)


_UNDERWAY, _TOO_MANY_KEYS = _undecided(WireFate.UNDERWAY), _undecided(WireFate.TOO_MANY_KEYS)


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
        self._lock = world().lock()

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


def publish(session: zenoh.Session, sample: zenoh.Sample, congestion: zenoh.CongestionControl, copies: int) -> None:
    """Publish some copies of a message, without a publisher. Raises zenoh.ZError."""
    how: dict[str, Any] = {
        "congestion_control": congestion,
        "priority": sample.priority,
        "express": sample.express,
        "attachment": sample.attachment,
        "timestamp": sample.timestamp,
        "allowed_destination": REMOTE,
        "source_info": sample.source_info,
    }
    for _ in range(copies):
        if sample.kind == zenoh.SampleKind.PUT:
            session.put(sample.key_expr, sample.payload, encoding=sample.encoding, **how)
        else:
            session.delete(sample.key_expr, **how)
