"""Keys that come only once: what a wire declares for them and keeps of them."""

from __future__ import annotations

from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import pyarrow as pa
import pytest
import zenoh

from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.journal_words import KeyLimit
from evedrop.wire.on_disk import scorekeeper_on_disk
from evedrop.wire.plan import WirePlan
from evedrop.wire.publications import PublicationRelay, Publishers
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.scorekeeper import WireScorekeeper
from tests.conftest import LIMIT, wait_until
from tests.wire.test_publications import reader, ready
from tests.wire.wire_at_work import at_work, both_ways, is_declared, link, plan_of

BLOCK = zenoh.CongestionControl.BLOCK


@pytest.fixture
def declared(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The keys for which publishers are declared now; a key is frequent after 3 messages, and there is room for 8 keys."""
    monkeypatch.setattr("evedrop.wire.publications.OFTEN", 3)
    monkeypatch.setattr("evedrop.wire.publications.READY_KEYS", 8)
    monkeypatch.setattr("evedrop.wire.publications.MOST_PUBLISHERS", 2)
    keys: list[str] = []
    declare, release = Publishers.declare, Publishers.release

    def declares(self: Publishers, sample: zenoh.Sample, *rest: Any) -> zenoh.Publisher | None:
        publisher = declare(self, sample, *rest)
        if publisher is not None:
            keys.append(str(sample.key_expr))
        return publisher

    def releases(self: Publishers, publisher: zenoh.Publisher) -> None:
        keys.remove(str(publisher.key_expr))
        release(self, publisher)

    monkeypatch.setattr(Publishers, "declare", declares)
    monkeypatch.setattr(Publishers, "release", releases)
    return keys


@pytest.fixture
def few_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """The programs of a side may use five keys."""
    monkeypatch.setattr("evedrop.wire.journal_words.MOST_KEYS", 5)


@pytest.fixture
def relays(monkeypatch: pytest.MonkeyPatch) -> list[PublicationRelay]:
    """The relays of publications that wires have started."""
    started: list[PublicationRelay] = []
    start = PublicationRelay.start

    def starts(self: PublicationRelay) -> None:
        started.append(self)
        start(self)

    monkeypatch.setattr(PublicationRelay, "start", starts)
    return started


@pytest.mark.parametrize("plan", [both_ways(), plan_of(link("robot", "base"), link("robot", "third"))])
def test_publishers_are_declared_for_frequent_keys_only(tmp_path: Path, declared: list[str], plan: WirePlan) -> None:
    """There is a limited number of them, which other keys get when keys are not used any more; all messages cross in order.

    Also with two sides, where messages wait for their turn: a publisher is released after those that it has to send.
    """
    targets = len(plan.sides) - 1
    with at_work(plan, tmp_path) as wire, wire.program("robot") as sender, wire.program("base") as far:
        ready(wire, sender, far)
        got = reader(far, "key/**")
        wait_until(lambda: sender.put("key/ready", b"") or got, "the reader hears")
        sent: list[str] = []

        def put(key: str, priority: zenoh.Priority = zenoh.Priority.DATA) -> None:
            sender.put(f"key/{key}", str(len(sent)).encode(), congestion_control=BLOCK, priority=priority)
            sent.append(str(len(sent)))

        def arrived() -> list[str]:
            return [sample.payload.to_string() for sample in got if "ready" not in str(sample.key_expr)]

        def new_keys(name: str) -> None:
            for n in range(40):
                put(f"{name}/{n}")
            wait_until(lambda: arrived() == sent, "all arrive in order")

        new_keys("a")
        assert not [key for key in declared if key.startswith("key/a")]
        for _ in range(20):
            for name in ("one", "two", "three"):
                put(name)
        wait_until(lambda: arrived() == sent, "all arrive in order")
        assert len(declared) == 2 * targets
        new_keys("b")
        wait_until(lambda: not declared, "their publishers are released")
        for _ in range(8):
            put("three")
        wait_until(lambda: arrived() == sent, "all arrive in order")
        assert declared == ["key/three"] * targets
        put("three", zenoh.Priority.DATA_HIGH)
        wait_until(lambda: sorted(arrived(), key=int) == sent, "it arrives")
        wait_until(lambda: not declared, "its publisher is released")


def test_a_publisher_that_cannot_be_declared_takes_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh raises an error for it; the next one finds its place."""
    monkeypatch.setattr("evedrop.wire.publications.MOST_PUBLISHERS", 1)
    sample = SimpleNamespace(key_expr="scan", priority=zenoh.Priority.DATA, express=False)

    def refuse(*_: object, **__: object) -> None:
        raise zenoh.ZError("no")

    session = SimpleNamespace(declare_publisher=refuse)
    publishers = Publishers(cast(zenoh.Session, session))
    with pytest.raises(zenoh.ZError):
        publishers.declare(cast(zenoh.Sample, sample), BLOCK)
    session.declare_publisher = lambda *_, **__: "a publisher"
    declared: list[Any] = [publishers.declare(cast(zenoh.Sample, sample), BLOCK) for _ in range(2)]
    assert declared == ["a publisher", None]


def test_a_key_that_is_in_use_is_not_forgotten_for_new_ones(
    tmp_path: Path, declared: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise its fates would be computed again from its first message on, each time."""
    forgotten: list[str] = []
    monkeypatch.setattr("evedrop.wire.running_link.RunningLink.forget", lambda _self, _kind, key: forgotten.append(key))
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as sender:
        for n in range(100):
            sender.put("scan", b"", congestion_control=BLOCK)
            sender.put(f"new/{n}", b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 200, "the wire hears all")
        assert len(forgotten) > 80
        assert "scan" not in forgotten
        assert declared == ["scan"]


@pytest.mark.usefixtures("few_keys")
def test_keys_beyond_the_limit_are_dropped_and_the_wire_says_so(tmp_path: Path) -> None:
    """Once; the keys that are in use go on, and so do the other sides, whose programs have keys of their own."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        scorekeeper = WireScorekeeper(wire.relay.plan, wire.journal)
        for n in [*range(8), *range(8)]:
            robot.put(f"key/{n}", b"xyz", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 16, "the wire hears all")
        assert wire.fates() == 2 * ([WireFate.DELIVERED] * 5 + [WireFate.TOO_MANY_KEYS] * 3)
        assert wire.rows["n"].tolist() == [*[0] * 5, *[-1] * 3, *[1] * 5, *[-1] * 3]
        for n in range(5):
            base.put(f"order/{n}", b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 21, "the wire hears all")
        assert wire.fates("base-robot") == [WireFate.DELIVERED] * 5
        assert len(wire.told) == 1
        assert "the side robot have used 5 keys of 25 characters" in wire.told[0]
        summary = scorekeeper.links()["robot-base"]
    assert summary.dropped_by == {"too_many_keys": 6}
    assert (summary.heard, summary.delivered, summary.gap_messages) == (16, 10, 0)
    assert scorekeeper_on_disk(tmp_path, wire.relay.plan).links()["robot-base"] == summary
    rows = pa.concat_tables(journal_tables(tmp_path)).to_pylist()
    assert [row["key"] for row in rows if row["reason"] == "too_many_keys"] == [None] * 6
    assert [row["key"] for row in rows[:5]] == [f"key/{n}" for n in range(5)]


@pytest.mark.usefixtures("few_keys")
def test_the_keys_of_earlier_starts_keep_their_places(tmp_path: Path) -> None:
    """They go on with their numbers, and new ones find no room."""
    for start in range(2):
        with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot:
            for n in (*range(5), f"new/{start}"):
                robot.put(f"key/{n}", b"", congestion_control=BLOCK)
            wait_until(lambda: len(wire.rows) == 6, "the wire hears all")
            assert wire.rows["n"].tolist() == [start] * 5 + [-1]
            assert wire.fates() == [WireFate.DELIVERED] * 5 + [WireFate.TOO_MANY_KEYS]


def test_long_keys_need_more_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The characters of the keys are limited, too; a shorter key may still fit."""
    monkeypatch.setattr("evedrop.wire.journal_words.MOST_CHARACTERS", 100)
    told: list[str] = []
    plan = both_ways()
    limit = KeyLimit(plan.links, [("robot-base", "a" * 40, "put"), ("robot-base", "a" * 40, "query")], told.append)
    asked = {"a" * 40: True, "b" * 40: True, "c" * 40: False, "d" * 20: True, "e": False}
    assert {key: limit.admits(key, "robot") for key in asked} == asked
    assert len(told) == 1
    assert limit.admits("e", "base")


@pytest.mark.usefixtures("few_keys")
def test_a_key_with_a_sessions_id_counts_once_after_a_restart() -> None:
    """An earlier start numbered the keys of all sessions as those of one stream, which needs no place of its own then."""
    links = plan_of(link("robot", "base")).links
    limit = KeyLimit(links, [("robot-base", "scan/@adv", "put"), ("robot-base", "scan", "put")], lambda _: None)
    asked = {"scan/@adv/pub/a1": True, "scan/@adv/pub/b2": True, "scan": True, "x": True, "y": True, "z": False}
    assert {key: limit.admits(key, "robot") for key in asked} == asked


@pytest.mark.usefixtures("few_keys")
def test_a_query_with_a_new_key_beyond_the_limit_is_not_asked(tmp_path: Path) -> None:
    """Its asker waits, as for every query that is dropped."""
    plan = both_ways(query_seconds=0.3)
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        for n in range(5):
            robot.put(f"key/{n}", b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 5, "the wire hears all")
        base.declare_queryable("question", lambda query: query.reply("question", b"yes"))
        wait_until(lambda: is_declared(wire, "base", "queryable", "question"), "the queryable is declared")
        assert [*robot.get("question")] == []
        assert wire.fates()[-1] == WireFate.TOO_MANY_KEYS
        assert wire.rows[-1]["kind"] == Kind.QUERY


def test_what_waits_when_the_wire_ends_is_underway(tmp_path: Path, relays: list[PublicationRelay]) -> None:
    """A known key has its next number. A new one has none, so that the next start goes on as if it had not come."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        got = reader(base, "scan")
        wait_until(lambda: is_declared(wire, "base", "subscriber", "scan"), "the reader is there")
        robot.put("scan", b"", congestion_control=BLOCK)
        wait_until(lambda: got, "it crosses")
        for relay in relays:
            relay.leave(0.0)
        for key in ("scan", "new"):
            robot.put(key, b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 3, "the wire hears all")
        assert wire.fates() == [WireFate.DELIVERED, WireFate.UNDERWAY, WireFate.UNDERWAY]
        assert wire.rows["n"].tolist() == [0, 1, -1]
    assert len(got) == 1
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot:
        for key in ("scan", "new"):
            robot.put(key, b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 2, "the wire hears all")
        assert wire.rows["n"].tolist() == [2, 0]


def test_a_wire_that_ends_does_not_take_all_that_waits(
    tmp_path: Path, relays: list[PublicationRelay], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message holds up those after it until the wire ends; then they are underway, and each is in the journal."""
    monkeypatch.setattr("evedrop.wire.relay._LAST_SECONDS", -1.0)
    taken, ended = Event(), Event()
    way_to, leave = PublicationRelay._way_to, PublicationRelay.leave

    def slow(self: PublicationRelay, *rest: Any) -> Any:
        taken.set()
        assert ended.wait(LIMIT)
        return way_to(self, *rest)

    def leaves(self: PublicationRelay, until: float) -> None:
        leave(self, until)
        ended.set()

    monkeypatch.setattr(PublicationRelay, "_way_to", slow)
    monkeypatch.setattr(PublicationRelay, "leave", leaves)
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot:
        for n in range(100):
            robot.put(f"new/{n}", b"", congestion_control=BLOCK)
        assert taken.wait(LIMIT)
    rows = pa.concat_tables(journal_tables(tmp_path)).to_pylist()
    assert rows
    assert {(row["reason"], row["n"]) for row in rows} == {("underway", None)}
