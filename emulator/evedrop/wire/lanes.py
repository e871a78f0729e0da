"""The state of a link at this moment: whether it is cut, whether its queue has room, and the fates of each key.

A message meets, in this order: the queue of a link of limited rate, the limit of its size, sides that are joined outside the
wire, a cut, and the fate that the link's models give it. A message that is never lost meets the limit and joined sides only.

Source: docs/wire.md, how messages cross.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, final

from evedrop.model.slot.link import Change
from evedrop.wire.advanced import numbered_as
from evedrop.wire.fates import KeyFates, KeyLinks
from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import WireLink, WirePlan
from evedrop.wire.record import WireFate
from evedrop.wire.scheduler import KeyOrder

_CUT, _OVERFLOW, _TOO_LARGE = int(WireFate.CUT), int(WireFate.OVERFLOW), int(WireFate.TOO_LARGE)
_LOOPED = int(WireFate.LOOPED)

Decision = tuple[int, int, float, bool]
"""Number of the message, `WireFate` code, delay in seconds, whether it is delivered twice."""
_Stream = tuple[str, str]
"""Kind and key, as in `numbered_as`."""
Lane = Callable[[float, int], Decision]
"""Decides on the next message of a key, from the present time in seconds and the message's bytes."""


@final
class LinkState:
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
        self._links_of_keys: tuple[tuple[Change, ...], KeyLinks] | None = None  # the latest, which new keys share
        self._orders: dict[_Stream, KeyOrder] = {}
        self._lock = threading.Lock()
        self._free = 0.0  # when the queue will have sent all its messages
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
            order = self._orders.get(stream)
            if order is not None and order.due <= time.monotonic():
                del self._orders[stream]

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
                    wait = self._wait(now, size)
                    if wait is None:
                        return at, _OVERFLOW, 0.0, False
                    delay += wait
            if size > largest:
                return at, _TOO_LARGE, 0.0, False
            if self.looped:
                return at, _LOOPED, 0.0, False
            if self.cut:
                return at, _CUT, 0.0, False
            if order is not None and code == 0:
                delay = order.delay(delay, time.monotonic())
            return at, code, delay if code == 0 else 0.0, again

        return decide

    def _never(self, stream: _Stream) -> Lane:
        """For messages that are never lost: they take no fates, but they are numbered, and must not go round."""
        lock, largest, numbers = self._lock, self._largest, self._numbers
        with lock:
            numbers.setdefault(stream, self._counted(stream))
            self._lanes[stream] = self._lanes.get(stream, 0) + 1

        def decide(_now: float, size: int) -> Decision:
            with lock:
                at = numbers[stream]
                numbers[stream] = at + 1
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
            changes = self._journal.changes_of(self.link.name, key, kind)
            if self._links_of_keys is None or self._links_of_keys[0] != changes:
                self._links_of_keys = (changes, KeyLinks(self.link, self._seed, changes))
            fates = self._fates[stream] = KeyFates(
                self.link, key, kind, self._seed, start, links=self._links_of_keys[1]
            )
        return fates

    def _counted(self, stream: _Stream) -> int:
        """How many messages of a key and kind were numbered, as of the records that the journal has handed over."""
        kind, key = stream
        return self._journal.counts.get((self.link.name, key, kind), 0)

    def _set(self, settings: Mapping[str, Any]) -> None:
        self._settings = settings
        self._rate = float(settings.get("rate") or 0.0)
        self._queue = float(settings.get("queue") or 0.0)

    def _wait(self, now: float, size: int) -> float | None:
        """Seconds until the link has sent a message; None if its queue is full. The queue is never too small for one message."""
        wait = max(0.0, self._free - now)
        if wait > 0 and wait * self._rate + size > self._queue:
            return None
        self._free = max(self._free, now) + size / self._rate
        return wait + size / self._rate
