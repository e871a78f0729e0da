"""Publications that cross: what programs put and delete at one side goes to the other sides, as the links between them decide.

Payloads stay in Zenoh's memory: nothing here copies one into Python.

Source: docs/wire.md, how messages cross.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, final

import zenoh

from evedrop.threads import wait_for_thread
from evedrop.wire.crossing import AGAIN, UNLINKED, Crossing, Kind
from evedrop.wire.journal import WireJournal
from evedrop.wire.lanes import LinkState
from evedrop.wire.plan import WirePlan
from evedrop.wire.ros2 import SourceReader
from evedrop.wire.scheduler import Scheduler
from evedrop.wire.side import SideSession, expressions_of
from evedrop.wire.watchdog import Duty

WAITING = 8192
"""Messages of a side that may wait for the wire; then the side's programs wait, or Zenoh drops, as each message says."""
MOST_KEYS = 8192
"""Keys that a subscription keeps everything ready for; a key takes some 10 kB."""
_REMOTE = zenoh.Locality.REMOTE


@final
class Publishers:
    """The publishers that a wire has declared at a side, one for each key and quality of service."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: dict[tuple[str, str, str, bool], zenoh.Publisher] = {}
        self._lock = threading.Lock()

    def of(self, key: str, sample: zenoh.Sample) -> zenoh.Publisher:
        """The publisher of messages with the same key, priority, congestion control and express as a sample."""
        name = (key, str(sample.priority), str(sample.congestion_control), sample.express)
        with self._lock:
            if name not in self._declared:
                if len(self._declared) >= MOST_KEYS:
                    self._declared.pop(next(iter(self._declared)))
                self._declared[name] = self._session.declare_publisher(
                    sample.key_expr,
                    priority=sample.priority,
                    congestion_control=sample.congestion_control,
                    express=sample.express,
                    allowed_destination=_REMOTE,
                )
            return self._declared[name]


@final
class _Way:
    """The way of a key's messages over one link."""

    def __init__(self, state: LinkState, key: str, publishers: Publishers, lossless: bool) -> None:
        self.decide = state.lane("put", key, lossless)
        self.link = state.link.number
        self._key, self._publishers, self._state = key, publishers, state
        self._last: tuple[zenoh.Publisher, Any, Any, bool] | None = None

    def forget(self) -> None:
        """Release the resources of the key; its next message gets the next fate all the same."""
        self._state.forget("put", self._key)

    def publisher(self, sample: zenoh.Sample) -> zenoh.Publisher:
        """The publisher for a message; nearly always that of the message before."""
        last = self._last
        if (
            last is not None
            and last[1] == sample.priority
            and last[2] == sample.congestion_control
            and last[3] == sample.express
        ):
            return last[0]
        found = self._publishers.of(self._key, sample)
        self._last = (found, sample.priority, sample.congestion_control, sample.express)
        return found


_Ways = tuple[tuple[_Way, ...], int]
"""The ways of a key, and its code in the journal."""


@final
class PublicationRelay:
    """Takes the publications of a side from Zenoh, and gives them to the other sides."""

    def __init__(
        self,
        side: SideSession,
        links: Mapping[str, LinkState],
        publishers: Mapping[str, Publishers],
        plan: WirePlan,
        journal: WireJournal,
        scheduler: Scheduler,
        tell: Callable[[str], None],
    ) -> None:
        """links, publishers: by the names of links and of sides; tell: for what the user must know."""
        self._links, self._publishers, self._plan = links, publishers, plan
        self._journal, self._scheduler = journal, scheduler
        self._side, self._name, self._tell = side, side.name, tell
        self.duties: list[Duty] = []
        expressions = [zenoh.KeyExpr(one) for one in expressions_of(side.side, plan.links)]
        self._subscribers = []
        self._threads = []
        for at, expression in enumerate(expressions):
            channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(WAITING)
            subscriber = side.session.declare_subscriber(expression, channel, allowed_origin=_REMOTE)
            earlier = tuple(one for one in expressions[:at] if one.intersects(expression))
            self._subscribers.append(subscriber)
            self.duties.append(Duty(f"among the messages from the side {side.name}"))
            arguments = (subscriber, earlier, self.duties[-1])
            self._threads.append(
                threading.Thread(target=self._run, args=arguments, name=f"from {side.name}", daemon=True)
            )

    def start(self) -> None:
        """Begin to take messages."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End; messages that Zenoh has already handed over still cross."""
        with self._side.duty.busy():
            for subscriber in self._subscribers:
                subscriber.undeclare()
        for thread in self._threads:
            wait_for_thread(thread)

    def _run(self, samples: Any, earlier: tuple[zenoh.KeyExpr, ...], duty: Duty) -> None:
        try:
            self._take_all(samples, earlier, duty)
        except Exception as error:  # whatever it is: nothing may silently stop crossing
            self._tell(f"messages from the side {self._name} no longer cross ({error!r}); end the wire and report this")

    def _take_all(self, samples: Any, earlier: tuple[zenoh.KeyExpr, ...], duty: Duty) -> None:
        take = self._taker()
        for sample in samples:
            duty.in_hand = sample
            # A message that several subscriptions hear belongs to the first.
            if not earlier or not any(one.intersects(sample.key_expr) for one in earlier):
                take(sample)
            duty.in_hand = None

    def _taker(self) -> Callable[[zenoh.Sample], None]:
        """The function that is called for every message: it looks up as little as possible."""
        ways_of: dict[str, _Ways] = {}
        now, way_to = time.time, self._way_to
        record, hold, amend = self._journal.record, self._scheduler.hold, self._journal.amend
        read = SourceReader(self._journal.source_code)
        put, put_kind, delete_kind = zenoh.SampleKind.PUT, int(Kind.PUT), int(Kind.DELETE)
        unlinked, held_up, refused, zenoh_error = (
            int(Crossing.UNLINKED),
            Crossing.HELD_UP,
            Crossing.REFUSED,
            zenoh.ZError,
        )

        def take(sample: zenoh.Sample) -> None:
            heard = now()
            key = str(sample.key_expr)
            found = ways_of.get(key)
            ways, code = way_to(ways_of, key, sample.key_expr) if found is None else found
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
                record(heard, -1, sequence, 0.0, code, sender, size, UNLINKED, kind, unlinked)
            for way in ways:
                n, fate, delay, again = way.decide(heard, size)
                row = record(
                    heard, n, sequence, delay, code, sender, size, way.link, kind | AGAIN if again else kind, fate
                )
                if fate:
                    continue
                try:
                    publisher = way.publisher(sample)
                    if delay:
                        copies = 2 if again else 1
                        if not hold(delay, size, row, _Later(publisher, sample, is_put, copies)):
                            amend(row, held_up)
                    elif is_put:
                        publisher.put(
                            payload,
                            encoding=sample.encoding,
                            attachment=attachment,
                            timestamp=sample.timestamp,
                            source_info=source,
                        )
                        if again:
                            _send(publisher, sample, is_put)
                    else:
                        _send(publisher, sample, is_put)
                        if again:
                            _send(publisher, sample, is_put)
                except zenoh_error:
                    amend(row, refused)

        return take

    def _way_to(self, ways_of: dict[str, _Ways], key: str, expression: zenoh.KeyExpr) -> _Ways:
        """The ways of a key that is heard for the first time, or again after many other keys, and its code."""
        while len(ways_of) >= MOST_KEYS:
            oldest = next(iter(ways_of))
            for way in ways_of.pop(oldest)[0]:
                way.forget()
        code = self._journal.key_code(key)
        lossless = self._plan.is_lossless(expression)
        taken = (self._plan.link_of(self._name, target, expression) for target in self._publishers)
        ways = tuple(
            _Way(self._links[link.name], key, self._publishers[link.target], lossless)
            for link in taken
            if link is not None
        )
        ways_of[key] = (ways, code)
        return ways, code


@final
class _Later:
    """A message that is sent when its delay is over."""

    __slots__ = ("_copies", "_is_put", "_publisher", "_sample")

    def __init__(self, publisher: zenoh.Publisher, sample: zenoh.Sample, is_put: bool, copies: int) -> None:
        self._publisher, self._sample, self._is_put, self._copies = publisher, sample, is_put, copies

    def __call__(self) -> None:
        for _ in range(self._copies):
            _send(self._publisher, self._sample, self._is_put)


def _send(publisher: zenoh.Publisher, sample: zenoh.Sample, is_put: bool) -> None:
    """Publish a message whole. Raises zenoh.ZError."""
    if is_put:
        publisher.put(
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            timestamp=sample.timestamp,
            source_info=sample.source_info,
        )
    else:
        publisher.delete(attachment=sample.attachment, timestamp=sample.timestamp, source_info=sample.source_info)
