"""The content of a wire file: sides, links between them with the keys that they take, events.

Made by `evedrop.wire.file` and read by everything else. Zenoh's advanced publishers have keys of their own for the messages on
KEY: KEY/@adv/… for their history, heartbeats and recovery. After `@adv` come the Zenoh id of a session, and numbers of its own,
which differ from run to run.

Source: docs/wire/file.md, the file; docs/wire/semantics.md, late joiners.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import zenoh

from evedrop.wire.tables import TlsTable, WireExpectTable

_MARK = "/@adv"
_HISTORY = f"{_MARK}/"
LOST_HISTORY_SECONDS: Final = 0.5
"""How long the asker of a history waits for a lost question or answer: an advanced subscriber holds back new messages."""


def published_key(key: str) -> str | None:
    """KEY, if a key is `KEY/@adv/…`; None for all other keys."""
    return key.partition(_HISTORY)[0] if _HISTORY in key else None


def numbered_as(key: str) -> str:
    """The key with which messages share their numbers and random streams: `KEY/@adv` for `KEY/@adv/…`, or else their own."""
    published = published_key(key)
    return key if published is None else f"{published}{_MARK}"


@dataclass(frozen=True)
class Side:
    """A place at which programs connect: a Zenoh router session of the wire."""

    name: str
    listen: tuple[str, ...] = ()
    """Zenoh endpoints; port 0 stands for any free port."""
    connect: tuple[str, ...] = ()
    """Endpoints of routers that are there already."""
    tls: TlsTable | None = None
    users: Mapping[str, str] | None = None
    """User → password of those who may connect; None: everybody may."""
    keys: tuple[str, ...] = ("**",)
    """The key expressions that programs on this side may use; all others are refused by access control."""
    peers: bool = False
    """Whether its programs may be in Zenoh's mode peer, because nothing introduces them to programs of other sides."""


@dataclass(frozen=True)
class WireLink:
    """One direction between two sides, for some keys."""

    name: str
    number: int
    """Its place among the links of the file, from 0: its code in the journal."""
    source: str
    """The side whose messages it carries."""
    target: str
    """The side that gets them."""
    keys: str
    """A Zenoh key expression. The first link of the file that has source, target and key takes a message."""
    settings: Mapping[str, Any]
    """As `evedrop.model.slot.link.LinkSchedule.settings`, with a message of a key as a slot, delays in seconds,
    `rate` in bytes per second and `queue` in bytes."""
    tap: bool = False
    """Whether it only copies publications, and carries no queries."""
    ordered: bool = False
    """Whether no message is delivered before an earlier one of its key."""
    correlation: tuple[str, float] | None = None
    """The name of the link whose losses these are tied to, and how strongly."""

    @cached_property
    def expression(self) -> zenoh.KeyExpr:
        """The key expression, for `includes` and `intersects`."""
        return zenoh.KeyExpr(self.keys)

    def takes(self, key: zenoh.KeyExpr) -> bool:
        """Whether a message with this key, which may contain wildcards, is one of this link's.

        The history of an advanced publisher, `KEY/@adv/…`, goes where its key goes.
        """
        return any(self.expression.intersects(each) for each in _with_published(key))

    def takes_all(self, key: zenoh.KeyExpr) -> bool:
        """Whether all messages with this key, which may contain wildcards, are this link's."""
        return any(self.expression.includes(each) for each in _with_published(key))


@dataclass(frozen=True)
class WireEvent:
    """Something that happens at a time, or from one time to another."""

    start: float
    """Seconds after the start of the wire."""
    stop: float | None
    """None: it lasts."""
    partition: tuple[str, str] | None = None
    """Two sides between which nothing passes but liveliness and what is lossless."""
    cut: str | None = None
    """The name of a link that is cut."""
    link: str | None = None
    """The name of a link whose settings change."""
    settings: Mapping[str, Any] | None = None
    """Those of its settings that change, and what they change to."""
    note: str | None = None


@dataclass(frozen=True)
class WirePlan:
    """A wire."""

    seed: int
    sides: Mapping[str, Side]
    links: tuple[WireLink, ...]
    events: tuple[WireEvent, ...] = ()
    lossless: tuple[str, ...] = ()
    """Key expressions of messages that no link loses, delays or holds up."""
    largest: int = 2**30
    """Bytes of the largest message."""
    query_seconds: float = 10.0
    """For how long a query waits for replies from the other sides."""
    held_messages: int = 100_000
    """The most messages that wait for their delay to be over, on all links together."""
    held_bytes: int = 2**30
    """Their most bytes."""
    expectations: tuple[WireExpectTable, ...] = ()

    def link_of(self, source: str, target: str, key: zenoh.KeyExpr, *, query: bool = False) -> WireLink | None:
        """The first link that takes the messages of a key from one side to another; None if no link does.

        query: whether they are queries or replies, which no tap carries.
        """
        for link in self._between.get((source, target), ()):
            if link.takes(key) and not (query and link.tap):
                return link
        return None

    def named(self, name: str) -> WireLink:
        """The link with this name. Raises KeyError if no link has it."""
        return {link.name: link for link in self.links}[name]

    def is_lossless(self, key: zenoh.KeyExpr) -> bool:
        """Whether messages with this key are never lost: it is named, or it is `KEY/@adv/…` and KEY is named."""
        if not self.lossless:
            return False
        return any(lossless.includes(each) for each in _with_published(key) for lossless in self._never_lost)

    @cached_property
    def _between(self) -> Mapping[tuple[str, str], tuple[WireLink, ...]]:
        """(source, target) → the links between these sides, in the order of the file."""
        ways = {(link.source, link.target) for link in self.links}
        return {way: tuple(link for link in self.links if (link.source, link.target) == way) for way in ways}

    @cached_property
    def _never_lost(self) -> tuple[zenoh.KeyExpr, ...]:
        return tuple(map(zenoh.KeyExpr, self.lossless))


def _with_published(key: zenoh.KeyExpr) -> Iterator[zenoh.KeyExpr]:
    """The key; and KEY as well if it is the history of an advanced publisher, `KEY/@adv/…`."""
    yield key
    if (published := published_key(str(key))) is not None:
        yield zenoh.KeyExpr(published)
