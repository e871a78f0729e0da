"""The fates of the messages of a key on a link: seed, link, kind, key and n determine the fate of the n-th message.

A link of a scenario decides the fate of a packet in each slot. Here the n-th message of a key is slot n, and a slot lasts a
second, so that every model of losses and delays is used unchanged. Time-dependent effects are not part of a fate: the queue
of a link of limited rate, cuts and partitions.

Source: docs/wire.md, the same traffic, the same losses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import repeat
from typing import Any, final

from evedrop.model.slot.link import NEVER, Change, Fates, Link, LinkSchedule
from evedrop.model.streams import Batch, ShortReader, root_of_seed, stream_keys
from evedrop.scenario.wire_table import wire_stream
from evedrop.wire.advanced import numbered_as
from evedrop.wire.plan import WireLink

MessageFate = tuple[int, float, bool]
"""`WireFate` code, delay in seconds, and whether a second copy arrives with the first."""
_FIRST_BLOCK, _LARGEST_BLOCK = 8, 2048  # fates made at once: a key with few messages needs little time and memory
_LITTLE = 64  # messages after which a key is not new any more
_PASSED_AT_ONCE = 65_536
_LATEST = 2**32 - 1  # seconds: more than the longest delay, so that no message is too late
_BY_TIME = frozenset({"rate", "queue"})
_MESSAGES = Batch(NEVER, 1)
_PROMPT = tuple((code, 0.0, False) for code in range(256))  # shared by all messages without delay and copy


@final
class KeyFates:
    """The fates of one key's messages of one kind on one link, in order. All keys `KEY/@adv/…` count as one key.

    kind: `put` (deletes are puts), `query` or `reply`; start: the number of the first message to decide; changes: earlier
    changes of the settings, each at the number of the first message that had them.

    links: made from the link, the seed and the changes; keys may share them.

    Only one thread may call its methods at a time: `LinkState` holds its lock.
    """

    __slots__ = ("_block", "_key", "_kind", "_link", "_links_of_keys", "_ready", "_stop")

    def __init__(
        self,
        link: WireLink,
        key: str,
        kind: str,
        seed: int,
        start: int = 0,
        changes: Iterable[Change] = (),
        links: KeyLinks | None = None,
    ) -> None:
        self._links_of_keys = links or KeyLinks(link, seed, changes)
        self._kind, self._key = kind, numbered_as(key)
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
        self._block = _FIRST_BLOCK
        slots = range(self._stop, self._stop + self._block)
        self._stop = slots.stop
        return _rows(self._links_of_keys.link(self._kind, self._key, slots.start, short=True).fates(slots))

    def _planned(self) -> list[MessageFate]:
        """The fates of the next block, the last one first."""
        if self._link is None:
            self._link = self._links_of_keys.link(self._kind, self._key, self._stop)
        self._block = min(8 * self._block or _FIRST_BLOCK, _LARGEST_BLOCK)
        slots = range(self._stop, self._stop + self._block)
        self._stop = slots.stop
        return _rows(self._link.planned(slots))


@final
class KeyLinks:
    """How a link decides on the messages of each key: what does not depend on the key is made once."""

    def __init__(self, link: WireLink, seed: int, changes: Iterable[Change]) -> None:
        """changes: as for `KeyFates`."""
        schedule = _schedule_of(link, changes)
        self._long = Link(schedule, link.name, {}, _MESSAGES)
        self._short = Link(schedule, link.name, {}, _MESSAGES, ShortReader)
        self._stream_key = stream_keys(root_of_seed(seed))

    def link(self, kind: str, key: str, start: int, *, short: bool = False) -> Link:
        """The link, which decides on message `start` next: the memory of a loss model is that of all messages before.

        short: whether it decides on few messages in all.
        """
        link = (self._short if short else self._long).like(_StreamKeys(self._stream_key, kind, key))
        for first in range(0, start, _PASSED_AT_ONCE):
            link.fates(range(first, min(first + _PASSED_AT_ONCE, start)))
        return link


def _schedule_of(link: WireLink, changes: Iterable[Change]) -> LinkSchedule:
    """The schedule of a link for the messages of a key. changes: as for `KeyFates`."""
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
