"""A link of a running wire: it decides the fate of each message, and holds it back until its delay is over.

Seed, link, kind, key and n determine the fate of the n-th message. A link of a scenario decides the fate of a packet in each
slot; here the n-th message of a key is slot n, and a slot lasts a second, so that every model of losses and delays is used
unchanged. Time-dependent effects are not part of that fate. A message meets, in this order: the queue of a link of limited rate,
the limit of its size, sides that are joined outside the wire, a cut, and the fate that the link's models give it. A message that
is never lost meets the limit and joined sides only. Messages that are held back are passed on in the order of their times.

Source: docs/wire/semantics.md, the same traffic, the same losses, and messages.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import repeat
from typing import Any, NamedTuple, final

from evedrop.model.slot.link import NEVER, Change, Fates, Link, LinkSchedule
from evedrop.model.streams import Batch, SingleTrialReader, root_of_seed, stream_keys
from evedrop.scenario.receivers import wire_stream
from evedrop.system.waiting import SYSTEM_CLOCK, Clock, wait_for_thread
from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import WireLink, WirePlan, numbered_as
from evedrop.wire.records import WireFate
from evedrop.wire.watchdog import Duty

MessageFate = tuple[int, float, bool]
"""`WireFate` code, delay in seconds, and whether a second copy arrives with the first."""
_FIRST_BLOCK, _LARGEST_BLOCK = 8, 2048  # fates made at once: a key with few messages needs little time and memory
_LITTLE = 64  # messages after which a key is not new any more
_LATEST = 2**32 - 1  # seconds: more than the longest delay, so that no message is too late
_BY_TIME = frozenset({"rate", "queue"})
_MESSAGES = Batch(NEVER, 1)
_PROMPT = tuple((code, 0.0, False) for code in range(256))  # shared by all messages without delay and copy


@final
class KeyFates:
    """The fates of one key's messages of one kind on one link, in order. All keys `KEY/@adv/…` count as one key.

    links: of the link, which keys share; kind: `put` (deletes are puts), `query` or `reply`; start: the number of the first
    message to decide.

    Only one thread may call its methods at a time: `RunningLink` holds its lock.
    """

    __slots__ = ("_block", "_key", "_kind", "_link", "_links_of_keys", "_ready", "_stop")

    def __init__(self, links: PerKeyLinks, kind: str, key: str, start: int = 0) -> None:
        self._links_of_keys, self._kind, self._key = links, kind, numbered_as(key)
        self._link: Link | None = None
        self._stop = start  # the end of the fates in `_ready`
        self._block = 0
        self._ready: list[MessageFate] = []  # the next fates, the last one first

    def next(self) -> MessageFate:
        """The fate of the next message."""
        try:
            return self._ready.pop()
        except IndexError:
            self._ready = self._first() if self._stop < _LITTLE and not self._block else self._planned()
            return self._ready.pop()

    @property
    def n(self) -> int:
        """The number of the next message."""
        return self._stop - len(self._ready)

    def change(self, settings: Mapping[str, Any]) -> int:
        """Give the link other settings, as in `WireLink.settings`. Returns the number of the first message that has them."""
        at = self.n
        if self._link is None or not self._ready:
            self._stop = at
            self._planned()
        assert self._link is not None  # noqa: S101 - it has planned
        self._ready = _rows(self._link.amended(at, [Change(at, _timeless(settings))]))
        return at

    def _first(self) -> list[MessageFate]:
        """The fates of the first block, without a link that is kept: most keys of many have few messages."""
        slots = self._next_block(_FIRST_BLOCK)
        return _rows(self._links_of_keys.link(self._kind, self._key, slots.start, short=True).fates(slots))

    def _planned(self) -> list[MessageFate]:
        """The fates of the next block, the last one first."""
        if self._link is None:
            self._link = self._links_of_keys.link(self._kind, self._key, self._stop)
        return _rows(self._link.planned(self._next_block(min(8 * self._block or _FIRST_BLOCK, _LARGEST_BLOCK))))

    def _next_block(self, size: int) -> range:
        """The numbers of the next messages that are decided together."""
        self._block, start = size, self._stop
        self._stop += size
        return range(start, self._stop)


@final
class PerKeyLinks:
    """How a link decides on the messages of each key: what does not depend on the key is made once."""

    def __init__(self, link: WireLink, seed: int, changes: Iterable[Change]) -> None:
        """changes: earlier changes of the settings, each at the number of the first message that had them."""
        schedule = _schedule_of(link, changes)
        self._long = Link(schedule, link.name, {}, _MESSAGES)
        self._short = Link(schedule, link.name, {}, _MESSAGES, SingleTrialReader)
        self._stream_key = stream_keys(root_of_seed(seed))

    def link(self, kind: str, key: str, start: int, *, short: bool = False) -> Link:
        """The link, which decides on message `start` next: the memory of a loss model is that of all messages before.

        short: whether it decides on few messages in all.
        """
        link = (self._short if short else self._long).like(_StreamKeys(self._stream_key, kind, key))
        link.skip(start)
        return link


def _schedule_of(link: WireLink, changes: Iterable[Change]) -> LinkSchedule:
    """The schedule of a link for the messages of a key. changes: as for `PerKeyLinks`."""
    # Of several changes at one message the last one counts, as with `KeyFates.change`.
    last = {change.at: change for change in sorted(changes, key=lambda change: change.at)}
    first = last.pop(0, Change(0))  # most keys have no other: a schedule without changes is quicker
    made = tuple(
        Change(at, None if change.settings is None else _timeless(change.settings)) for at, change in last.items()
    )
    settings = link.settings if first.settings is None else first.settings
    return LinkSchedule(_timeless(settings), _LATEST, made, correlation=link.correlation)


@final
class _StreamKeys(dict[str, bytes]):
    """The keys of the random streams of a key's messages, each made when it is asked for: a new key needs few of them."""

    __slots__ = ("_of",)

    def __init__(self, stream_key: Callable[[str], bytes], kind: str, key: str) -> None:
        self._of = (stream_key, kind, key)

    def __missing__(self, stream: str) -> bytes:
        stream_key, kind, key = self._of
        return stream_key(wire_stream(stream, kind, key))


def _timeless(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """The settings without those whose effect depends on time."""
    return {name: value for name, value in settings.items() if name not in _BY_TIME}


def _rows(fates: Fates) -> list[MessageFate]:
    """The fates of consecutive messages, the last one first."""
    codes = fates.codes[::-1, 0].tolist()
    if fates.delays is None and fates.again is None:
        return [_PROMPT[code] for code in codes]
    delays: Iterable[float] = repeat(0.0)
    if fates.delays is not None and fates.rests is not None:
        delays = (fates.delays[::-1, 0] + fates.rests[::-1]).tolist()
    again = repeat(False) if fates.again is None else fates.again[::-1, 0].tolist()
    return list(zip(codes, delays, again, strict=False))


class _Held(NamedTuple):
    due: float
    serial: int
    size: int
    row: int
    send: Callable[[], object]


@final
@dataclass(slots=True)
class KeyOrder:
    """Messages of which none is sent before an earlier one, such as those of a key."""

    due: float = 0.0
    """When the latest decided message is due, in seconds of the monotonic clock."""
    _latest: float = 0.0

    def delay(self, delay: float, now: float) -> float:
        """The delay, in seconds, of the next message, which by itself has another one."""
        self.due = max(self.due, now + delay)
        return self.due - now

    def send_at(self, due: float) -> float:
        """When a message is sent that is due at a time: not before the one that was held before."""
        self._latest = max(self._latest, due)
        return self._latest


@final
class Scheduler:
    """A thread that carries out tasks when they are due. It holds a limited number of messages, and of bytes."""

    def __init__(self, most: int, most_bytes: int, failed: Callable[[int], None], clock: Clock = SYSTEM_CLOCK) -> None:
        """most, most_bytes: how much it may hold; failed: is given the row of a message that raised an error."""
        self._clock = clock
        self._most, self._most_bytes, self._failed = most, most_bytes, failed
        self._heap: list[_Held] = []
        self._bytes = 0
        self._serial = itertools.count()
        self._changed = world().condition()
        self._ended = False
        self.duty = Duty("among the delayed messages")
        self._thread = world().thread(self._run, name="delays")
        self._thread.start()

    def hold(
        self,
        delay: float,
        size: int,
        row: int,
        send: Callable[[], object],
        order: KeyOrder | None = None,
        since: float | None = None,
    ) -> bool:
        """Send a message of some bytes after some seconds, or later to keep an order; returns whether there is room for it.

        row: its row in the journal; since: when the delay begins, in seconds of the monotonic clock; None: now.
        """
        with self._changed:
            if self._ended or len(self._heap) >= self._most or self._bytes + size > self._most_bytes:
                return False
            due = (self._clock.monotonic() if since is None else since) + delay
            held = _Held(due if order is None else order.send_at(due), next(self._serial), size, row, send)
            heapq.heappush(self._heap, held)
            self._bytes += size
            if self._heap[0] is held:
                self._changed.notify()
        return True

    def close(self) -> list[int]:
        """End the thread. Returns the rows of the messages that were not sent."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        wait_for_thread(self._thread)
        left, self._heap = [held.row for held in sorted(self._heap)], []
        return left

    def _run(self) -> None:
        while True:
            with self._changed:
                held = self._due()
            if held is None:
                return
            self.duty.in_hand = held
            try:
                held.send()
            except Exception:
                self._failed(held.row)
            self.duty.in_hand = None

    def _due(self) -> _Held | None:
        """The next message, when it is due; None at the end. The lock is held."""
        while not self._ended:
            if not self._heap:
                self._clock.wait(self._changed, None)
                continue
            wait = self._heap[0].due - self._clock.monotonic()
            if wait <= 0:
                held = heapq.heappop(self._heap)
                self._bytes -= held.size
                return held
            self._clock.wait(self._changed, wait)
        return None


_CUT, _OVERFLOW, _TOO_LARGE = int(WireFate.CUT), int(WireFate.OVERFLOW), int(WireFate.TOO_LARGE)
_LOOPED = int(WireFate.LOOPED)

Decision = tuple[int, int, float, bool]
"""Number of the message, `WireFate` code, delay in seconds, whether it is delivered twice."""
_Stream = tuple[str, str]
"""Kind and key, as in `numbered_as`."""
Lane = Callable[[float, int], Decision]
"""Decides on the next message of a key, from the present time in seconds of the monotonic clock and the message's bytes."""


@final
class RunningLink:
    """A link while the wire runs. Threads may call its methods at the same time."""

    def __init__(self, link: WireLink, plan: WirePlan, journal: WireJournal) -> None:
        self.link = link
        self.cut = False
        """Whether an event cuts it, or parts its sides."""
        self.looped = False
        """Whether its sides are joined outside the wire, so that its messages would go round."""
        self._seed, self._largest = plan.seed, plan.largest
        self._journal = journal
        self._fates: dict[_Stream, KeyFates] = {}
        self._lanes: dict[_Stream, int] = {}
        """How many keys share each stream: several for the history of an advanced publisher."""
        self._numbers: dict[_Stream, int] = {}
        self._links_of_keys: tuple[tuple[Change, ...], PerKeyLinks] | None = None  # the latest, which new keys share
        self._orders: dict[_Stream, KeyOrder] = {}
        self._lock = world().lock()
        self._rate = 0.0
        self._free = 0.0  # when the queue will be empty, on the monotonic clock, as are all its times
        # The order in which a key's messages leave the queue, whatever the rate becomes.
        self._queued: dict[_Stream, KeyOrder] = {}
        self._set(link.settings)

    def change(self, settings: Mapping[str, Any]) -> None:
        """Give the link other settings from the next message of each key on."""
        with self._lock:
            if settings == self._settings:
                return
            counts = dict(self._journal.counts)  # a copy: the journal's thread goes on counting
            since = {(key, kind): n for (link, key, kind), n in counts.items() if link == self.link.name}
            since |= {(key, kind): n for (kind, key), n in self._numbers.items()}
            since |= {(key, kind): fates.change(settings) for (kind, key), fates in self._fates.items()}
            self._set(settings)
            self._journal.change(self.link.name, settings, since)

    def lane(self, kind: str, key: str, lossless: bool) -> Lane:
        """What decides on the messages of a key and kind."""
        stream = (kind, numbered_as(key))
        return self._never(stream) if lossless else self._decide(stream)

    def order(self, kind: str, key: str) -> KeyOrder | None:
        """The order that messages of a key and kind keep; None if they may overtake each other."""
        return self._orders.get((kind, numbered_as(key))) if self._orders else None

    def forget(self, kind: str, key: str) -> None:
        """Keep only the number of the next message of a key and kind, until there is one: the journal's, if it has it."""
        stream = (kind, numbered_as(key))
        with self._lock:
            if stream not in self._lanes:
                return
            self._lanes[stream] -= 1
            if self._lanes[stream]:
                return
            del self._lanes[stream]
            fates = self._fates.pop(stream, None)
            n = self._numbers.pop(stream, None) if fates is None else fates.n
            if n is not None and n != self._counted(stream):
                self._numbers[stream] = n
            now = world().monotonic()
            for orders in (self._orders, self._queued):
                if stream in orders and orders[stream].due <= now:
                    del orders[stream]

    def _decide(self, stream: _Stream) -> Lane:
        lock, largest = self._lock, self._largest
        with lock:
            fates = self._fates_of(stream)
            after = fates.next
            order = self._orders.setdefault(stream, KeyOrder()) if self.link.ordered else None
            self._lanes[stream] = self._lanes.get(stream, 0) + 1

        def decide(now: float, size: int) -> Decision:
            with lock:
                at = fates.n  # not counted here: another key may have the same fates
                code, delay, again = after()
                if self._rate:
                    wait = self._wait(stream, now, size)
                    if wait is None:
                        return at, _OVERFLOW, 0.0, False
                    delay += wait
                elif stream in self._queued:  # messages of a rate before wait on
                    delay += self._queued[stream].delay(0.0, now)
            if size > largest:
                return at, _TOO_LARGE, 0.0, False
            if self.looped:
                return at, _LOOPED, 0.0, False
            if self.cut:
                return at, _CUT, 0.0, False
            if order is not None and code == 0:
                delay = order.delay(delay, now)
            return at, code, delay if code == 0 else 0.0, again

        return decide

    def _never(self, stream: _Stream) -> Lane:
        """For messages that are never lost: they are numbered, and must not go round; the fates of their numbers do not count."""
        lock, largest, numbers, lossy = self._lock, self._largest, self._numbers, self._fates
        with lock:
            if stream not in lossy:
                numbers.setdefault(stream, self._counted(stream))
            self._lanes[stream] = self._lanes.get(stream, 0) + 1

        def decide(_now: float, size: int) -> Decision:
            with lock:
                fates = lossy.get(stream)
                if fates is None:
                    at = numbers[stream]
                    numbers[stream] = at + 1
                else:  # of another history of this key, which shares its numbers
                    at = fates.n
                    fates.next()
            if size > largest:
                return at, _TOO_LARGE, 0.0, False
            return at, _LOOPED if self.looped else 0, 0.0, False

        return decide

    def _fates_of(self, stream: _Stream) -> KeyFates:
        """The fates of a key and kind. The lock is held."""
        fates = self._fates.get(stream)
        if fates is None:
            kind, key = stream
            start = self._numbers.pop(stream) if stream in self._numbers else self._counted(stream)
            changes = self._journal.history.changes_of(self.link.name, key, kind)
            if self._links_of_keys is None or self._links_of_keys[0] != changes:
                self._links_of_keys = (changes, PerKeyLinks(self.link, self._seed, changes))
            fates = self._fates[stream] = KeyFates(self._links_of_keys[1], kind, key, start)
        return fates

    def _counted(self, stream: _Stream) -> int:
        """How many messages of a key and kind were numbered, as of the records that the journal has handed over."""
        kind, key = stream
        return self._journal.counts.get((self.link.name, key, kind), 0)

    def _set(self, settings: Mapping[str, Any]) -> None:
        self._settings = settings
        rate, now = float(settings.get("rate") or 0.0), world().monotonic()
        if self._free > now:  # its bytes wait on, but they pass at the new rate
            self._free = now + (self._free - now) * self._rate / rate if rate else now
        self._rate = rate
        self._queue = float(settings.get("queue") or 0.0)

    def _wait(self, stream: _Stream, now: float, size: int) -> float | None:
        """Seconds until the link has sent a message; None if its queue is full. The queue is never too small for one message.

        A message that came before a change of the rate keeps its time, and later ones of its key and kind do not overtake it.
        """
        wait = max(0.0, self._free - now)
        if wait > 0 and wait * self._rate + size > self._queue:
            return None
        self._free = max(self._free, now) + size / self._rate
        order = self._queued.get(stream)
        if order is None:
            order = self._queued[stream] = KeyOrder()
        return order.delay(self._free - now, now)
