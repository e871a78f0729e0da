"""Wires at work for tests: real sides, real programs connected to them, and the rows of the journal."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import zenoh

from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import Side, WireLink, WirePlan
from evedrop.wire.records import RECORD, Records, WireFate
from evedrop.wire.relay import WireRelay, open_sides
from tests.conftest import LIMIT, wait_until

PERFECT: Mapping[str, Any] = {"loss": {"model": "bernoulli", "quality": 1.0}}
DEAD: Mapping[str, Any] = {"loss": {"model": "bernoulli", "quality": 0.0}}
LOSSY: Mapping[str, Any] = {"loss": {"model": "bernoulli", "quality": 0.6}}
ANYWHERE = "tcp/127.0.0.1:0"


def link(source: str, target: str, settings: Mapping[str, Any] = PERFECT, keys: str = "**", **fields: Any) -> WireLink:
    """A link, named after its sides unless the fields say otherwise; `plan_of` numbers it."""
    return WireLink(**{"name": f"{source}-{target}", "number": 0, "source": source, "target": target, "keys": keys,
                       "settings": settings, **fields})  # fmt: skip


def plan_of(*links: WireLink, sides: Mapping[str, Side] | None = None, **fields: Any) -> WirePlan:
    """A wire with these links, whose sides listen at any free port of this machine."""
    names = dict.fromkeys(name for link in links for name in (link.source, link.target))
    every_side = {name: Side(name, (ANYWHERE,)) for name in names} | dict(sides or {})
    numbered = tuple(WireLink(**{**_fields(link), "number": at}) for at, link in enumerate(links))
    return WirePlan(fields.pop("seed", 7), every_side, numbered, **fields)


def both_ways(settings: Mapping[str, Any] = PERFECT, back: Mapping[str, Any] = PERFECT, **fields: Any) -> WirePlan:
    """A wire of the sides robot and base, with a link each way."""
    return plan_of(link("robot", "base", settings), link("base", "robot", back), **fields)


class WireAtWork:
    """A wire that runs in this process."""

    def __init__(
        self, relay: WireRelay, journal: WireJournal, told: list[str], happened: list[str], rows: list[Records]
    ) -> None:
        self.relay, self.journal, self.told, self.happened = relay, journal, told, happened
        self.amended: list[WireFate] = []
        """Fates that rows were given after they had been handed to listeners."""
        journal.amendment_listeners.append(lambda _, fate: self.amended.append(fate))
        self._rows = rows

    def program(self, *sides: str, **config: Any) -> zenoh.Session:
        """A session of a program that is connected to these sides."""
        return program([endpoint for side in sides for endpoint in self.relay.endpoints[side]], **config)

    @property
    def rows(self) -> Records:
        """All rows of the journal so far."""
        self.journal.flush()
        rows: Records = np.concatenate([np.empty(0, RECORD), *self._rows])
        return rows

    def rows_of(self, key: str) -> Records:
        """The rows of a key so far."""
        rows = self.rows
        rows_of_key: Records = rows[rows["key"] == self.journal.words.key_code(key)]
        return rows_of_key

    def fates(self, link_name: str | None = None) -> list[WireFate]:
        """The fates of all messages so far, or of those on one link."""
        rows = self.rows
        if link_name is not None:
            rows = rows[rows["link"] == self.relay.links[link_name].link.number]
        return [WireFate(fate) for fate in rows["fate"].tolist()]

    def when_heard(self, count: int) -> list[WireFate]:
        """The fates, once there are that many."""
        wait_until(lambda: len(self.rows) >= count, f"{count} rows in the journal")
        return self.fates()


@contextlib.contextmanager
def at_work(plan: WirePlan, folder: Path) -> Iterator[WireAtWork]:
    """A wire that runs in this process."""
    told: list[str] = []
    rows: list[Records] = []
    with WireJournal(folder, plan, tell=told.append) as journal, open_sides(plan) as sides:
        journal.listeners.append(lambda block: rows.append(block.copy()))
        happened: list[str] = []
        with WireRelay(plan, journal, sides, told.append, happened.append) as relay:
            yield WireAtWork(relay, journal, told, happened, rows)


@contextlib.contextmanager
def sending(messages: list[str]) -> Iterator[None]:
    """A program that publishes `scan` at the side robot of a wire from the moment at which `run_wire` says its endpoint.

    messages: the list into which the wire says its lines.
    """
    ended = Event()

    def endpoints() -> list[str]:
        return [line.split(" ")[1] for line in messages if line.startswith("robot ")]

    def send() -> None:
        with program(wait_until(endpoints, "the wire's endpoints")) as session:
            while not ended.wait(0.01):
                session.put("scan", b"x")

    sender = Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join(LIMIT)


def program(endpoints: Sequence[str], **config: Any) -> zenoh.Session:
    """A session of a program; config: entries of Zenoh's configuration."""
    quiet = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    base = {
        "mode": "client",
        "connect": {"endpoints": list(endpoints)},
        "listen": {"endpoints": []},  # in mode peer it would listen on all interfaces
        "scouting": quiet,
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**base, **config})))


def is_declared(wire: WireAtWork, side: str, subject: str, key: str) -> bool:
    """Whether a program at a side has declared a `subscriber` or `queryable` that includes a key."""
    session, remote = wire.relay.sides[side].session, zenoh.Locality.REMOTE
    declared: zenoh.Publisher | zenoh.Querier
    if subject == "subscriber":
        declared = session.declare_publisher(key, allowed_destination=remote)
    else:
        declared = session.declare_querier(key, target=zenoh.QueryTarget.ALL, allowed_destination=remote)
    with declared:
        status: Any = declared.matching_status
        return bool(status.matching)


def _fields(link: WireLink) -> dict[str, Any]:
    return {name: getattr(link, name) for name in link.__dataclass_fields__}
