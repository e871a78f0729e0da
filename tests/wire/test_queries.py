"""Queries and their replies cross a wire whole, or are lost for a reason that the journal states."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, RecoveryConfig
from zenoh.ext import declare_advanced_publisher as advanced_publisher
from zenoh.ext import declare_advanced_subscriber as advanced_subscriber

from evedrop.wire.journal import WireJournal
from evedrop.wire.plan import LOST_HISTORY_SECONDS, Side
from evedrop.wire.queries import QueryRelay
from evedrop.wire.records import Kind, WireFate
from evedrop.wire.relay import WireRelay
from tests.conftest import wait_until
from tests.wire.wire_at_work import (
    ANYWHERE,
    DEAD,
    LOSSY,
    PERFECT,
    WireAtWork,
    at_work,
    both_ways,
    is_declared,
    link,
    plan_of,
)

COMPLETE = zenoh.QueryTarget.ALL_COMPLETE
ALL = zenoh.QueryTarget.ALL
WAIT = 0.3
"""Seconds for which the wires of these tests wait for replies."""


def answers(session: zenoh.Session, key: str, **how: Any) -> list[bytes]:
    """The payloads of all replies without an error."""
    replies = session.get(key, **{"timeout": 5.0, **how})
    return sorted(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)


def offer(session: zenoh.Session, key: str, answer: bytes, complete: bool = False) -> None:
    """Answer queries of a key, whatever they ask."""

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer)

    session.declare_queryable(key, reply, complete=complete)


def contents(query: zenoh.Query) -> tuple[str, str, bytes, str, bytes, int]:
    """All that a query carries."""
    payload, attachment, source = query.payload, query.attachment, query.source_info
    return (
        str(query.key_expr),
        str(query.parameters),
        b"" if payload is None else payload.to_bytes(),
        str(query.encoding),
        b"" if attachment is None else attachment.to_bytes(),
        -1 if source is None else source.source_sn,
    )


def kinds(wire: WireAtWork) -> list[tuple[int, int]]:
    """Kind and fate of all queries and replies."""
    return [(int(row["kind"]), int(row["fate"])) for row in wire.rows if row["kind"] in (Kind.QUERY, Kind.REPLY)]


def test_a_query_and_its_reply_cross_whole(tmp_path: Path) -> None:
    """Parameters, payload, encoding, attachment and source info of the query; timestamp and the rest of the reply."""
    heard: list[tuple[str, str, bytes, str, bytes, int]] = []
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        stamp = server.new_timestamp()

        def reply(query: zenoh.Query) -> None:
            with query:
                heard.append(contents(query))
                query.reply("map/1", b"42", encoding="text/plain", attachment=b"why", timestamp=stamp)
                query.reply_del("map/2", attachment=b"gone", timestamp=stamp)

        server.declare_queryable("map/*", reply)
        wait_until(lambda: list(asker.get("map/*", timeout=5.0)), "the queryable is there")
        heard.clear()
        replies = asker.get(
            "map/*?x=1;y=2",
            payload=b"give",
            encoding="text/json",
            attachment=b"me",
            source_info=zenoh.SourceInfo(asker.id, 5),
            timeout=5.0,
        )
        put, delete = sorted(
            (reply.ok for reply in replies if reply.ok is not None), key=lambda sample: str(sample.key_expr)
        )
        assert heard == [("map/*", "x=1;y=2", b"give", "text/json", b"me", 5)]
        assert (str(put.key_expr), put.payload.to_bytes(), str(put.encoding)) == ("map/1", b"42", "text/plain")
        assert str(put.timestamp) == str(stamp)
        assert put.attachment is not None
        assert put.attachment.to_bytes() == b"why"
        assert (str(delete.key_expr), delete.kind, str(delete.timestamp)) == (
            "map/2",
            zenoh.SampleKind.DELETE,
            str(stamp),
        )
        assert kinds(wire)[-3:] == [(Kind.QUERY, 0), (Kind.REPLY, 0), (Kind.REPLY, 0)]


def test_an_error_crosses(tmp_path: Path) -> None:
    """With its payload and encoding."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:

        def refuse(query: zenoh.Query) -> None:
            with query:
                query.reply_err(b"no", encoding="text/plain")

        server.declare_queryable("door", refuse)
        replies = wait_until(lambda: list(asker.get("door", timeout=5.0)), "the queryable is there")
        assert [(reply.err.payload.to_bytes(), str(reply.err.encoding)) for reply in replies] == [(b"no", "text/plain")]


def test_nobody_waits_for_a_queryable_that_is_not_there(tmp_path: Path) -> None:
    """The asker is told at once that there are no replies, and no message is recorded."""
    with at_work(both_ways(DEAD), tmp_path) as wire, wire.program("robot") as asker:
        assert not list(asker.get("nobody/here", timeout=60.0))
        assert not kinds(wire)


@pytest.mark.parametrize(
    ("lost", "fate"), [("there", WireFate.LOST), ("back", WireFate.LOST), ("large", WireFate.TOO_LARGE)]
)
def test_the_asker_of_a_lost_query_or_reply_waits(lost: str, fate: WireFate, tmp_path: Path) -> None:
    """For as long as the wire does: a radio that loses a reply does not say that there was none."""
    plan = plan_of(
        link("robot", "base", DEAD, "there/**", name="there"),
        link("robot", "base"),
        link("base", "robot", DEAD, "back/**", name="back"),
        link("base", "robot", keys="large/**", name="large"),
        link("base", "robot"),
        query_seconds=WAIT,
        largest=100,
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, f"{lost}/1", b"x" * 101 if lost == "large" else b"x")
        offer(server, "ready", b"x")
        wait_until(lambda: answers(asker, "ready"), "the queryables are there")
        asked = time.monotonic()
        assert not list(asker.get(f"{lost}/1", timeout=60.0))
        assert time.monotonic() - asked >= WAIT
        assert wire.fates(lost) == [fate]


def test_the_asker_waits_after_a_lost_reply_and_has_the_others(tmp_path: Path) -> None:
    """They come at once; that there are no more is not said before the wire's time for queries is over."""
    plan = plan_of(
        link("robot", "base"),
        link("base", "robot", DEAD, "map/1", name="dead"),
        link("base", "robot"),
        query_seconds=WAIT,
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "map/1", b"lost")
        offer(server, "map/2", b"not")
        offer(server, "ready", b"x")
        wait_until(lambda: answers(asker, "ready"), "the queryables are there")
        asked = time.monotonic()
        assert answers(asker, "map/*", timeout=60.0) == [b"not"]
        assert time.monotonic() - asked >= WAIT
        assert wire.fates("dead") == [WireFate.LOST]


@pytest.mark.parametrize(("full", "fates"), [("base", ["congested"]), ("robot", ["delivered", "congested"])])
def test_the_asker_of_a_query_or_reply_without_room_waits(full: str, fates: list[str], tmp_path: Path) -> None:
    """As if it had been lost: the programs of a side no longer read."""
    plan = both_ways(query_seconds=WAIT)
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "map", b"x")
        wait_until(lambda: answers(asker, "map"), "the queryable is there")
        before = len(wire.fates())
        send_queue = wire.relay._queries._send_queues[full]
        send_queue._most, send_queue._stopped = -1, True
        asked = time.monotonic()
        assert not list(asker.get("map", timeout=60.0))
        assert time.monotonic() - asked >= WAIT
        assert [fate.name.lower() for fate in wire.fates()[before:]] == fates


@pytest.mark.parametrize("lost", ["robot-base", "base-robot"])
def test_a_lost_question_for_a_history_ends_soon(lost: str, tmp_path: Path) -> None:
    """Long before other queries end: an advanced subscriber holds all new messages back until then."""
    plan = both_ways(
        DEAD if lost == "robot-base" else PERFECT, DEAD if lost == "base-robot" else PERFECT, query_seconds=1000.0
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "map/@adv/pub/1a/2/_", b"x")
        wait_until(lambda: is_declared(wire, "base", "queryable", "map/@adv/pub/1a/2/_"), "the queryable is there")
        asked = time.monotonic()
        assert not list(asker.get("map/@adv/*/1a/**", timeout=1000.0))
        assert time.monotonic() - asked >= LOST_HISTORY_SECONDS
        assert wire.fates(lost) == [WireFate.LOST]


def test_a_lost_question_does_not_stop_an_advanced_subscriber(tmp_path: Path) -> None:
    """It notices a lost message and asks for it; the question is lost; what follows comes all the same."""
    plan = both_ways(query_seconds=1000.0)
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot", timestamping={"enabled": True}) as robot,
        wire.program("base") as base,
    ):
        detection = MissDetectionConfig(heartbeat=1000.0, sporadic_heartbeat=None)
        publisher = advanced_publisher(
            robot, "map", cache=CacheConfig(max_samples=100), sample_miss_detection=detection, publisher_detection=True
        )
        got: list[str] = []
        subscriber: Any = advanced_subscriber(
            base, "map", lambda sample: got.append(sample.payload.to_string()),
            recovery=RecoveryConfig(heartbeat=True, periodic_queries=None),
        )  # fmt: skip
        wait_until(lambda: publisher.put("first") or got, "the subscriber is known")
        there, back = wire.relay.links["robot-base"], wire.relay.links["base-robot"]
        there.change(DEAD)
        lost = "lost" * 100
        publisher.put(lost)

        def is_lost() -> bool:  # that one, and not only a heartbeat
            return any(row["size"] >= len(lost) and row["fate"] == WireFate.LOST for row in wire.rows)

        wait_until(is_lost, "a message is lost")
        back.change(DEAD)  # before anything can make the subscriber ask
        there.change(PERFECT)
        publisher.put("next")
        wait_until(lambda: WireFate.LOST in wire.fates("base-robot"), "the question for it is lost")
        wait_until(lambda: "next" in got, "what follows comes")
        assert lost not in got
        subscriber.undeclare()


SERVICE = "0/add/example::srv::dds_::Add_/RIHS01_x"
SERVER = "@ros2_lv/0/abc/0/1/SS/%/%/server/%add/example::srv::dds_::Add_/RIHS01_x/::,10:,:,:,,"


def test_ros_finds_a_service_of_the_other_side(tmp_path: Path) -> None:
    """Queries for complete queryables alone reach it, and it is gone when its program is."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as asker:
        with wire.program("base") as server:
            offer(server, "open", b"open")
            offer(server, SERVICE, b"sum", complete=True)
            token = server.liveliness().declare_token(SERVER)
            wait_until(lambda: answers(asker, SERVICE, target=COMPLETE) == [b"sum"], "it is mirrored")
            assert answers(asker, SERVICE) == [b"sum"]
            assert answers(asker, SERVICE, target=ALL) == [b"sum"]
            assert answers(asker, "open") == [b"open"]
            assert not answers(asker, "open", target=COMPLETE)
            del token
        wait_until(lambda: not list(asker.get(SERVICE, target=COMPLETE)), "it is gone")


def test_a_service_that_zenoh_refuses_once_is_offered_at_the_next_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although no program declares anything since."""
    taker = QueryRelay._taker
    refused: list[str] = []

    def refusing(relay: QueryRelay, name: str, key: str | None, *earlier: Any) -> Any:
        if key is not None and not refused:
            refused.append(key)
            raise zenoh.ZError("busy")
        return taker(relay, name, key, *earlier)

    monkeypatch.setattr(QueryRelay, "_taker", refusing)
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, SERVICE, b"sum", complete=True)
        token = server.liveliness().declare_token(SERVER)
        wait_until(lambda: answers(asker, SERVICE, target=COMPLETE) == [b"sum"], "it is mirrored")
        assert refused == [SERVICE]
        assert [line for line in wire.told if "busy" in line]
        del token


def test_an_error_that_lasts_is_told_once_and_not_looked_for_without_a_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh says what programs declare to the first look, to no other until the fifth, and not to the last."""
    told: list[str] = []
    waits: list[float] = []
    plan = both_ways()
    with WireJournal(tmp_path, plan) as journal:
        relay = WireRelay(plan, journal, {}, told.append)

        def wait(seconds: float) -> None:
            waits.append(seconds)
            if len(waits) > 6:
                relay._ended.set()

        def poll() -> None:
            if len(waits) not in {1, 5}:
                raise zenoh.ZError("closed")

        monkeypatch.setattr(relay, "_woken", SimpleNamespace(wait=wait, clear=lambda: None))
        monkeypatch.setattr(relay, "_poll", poll)
        for name in ("_neighbours", "_bypasses"):
            monkeypatch.setattr(relay, name, SimpleNamespace(update=lambda: None), raising=False)
        monkeypatch.setattr("evedrop.wire.relay.world", lambda: SimpleNamespace(monotonic=lambda: sum(waits)))
        relay._keep_up()
    assert waits == pytest.approx([0.0, *6 * [0.2]])
    assert told == 2 * ["Zenoh does not say what programs declare (ZError('closed')); trying again"]


def test_each_query_is_asked_once(tmp_path: Path) -> None:
    """Although the mirrored queryable and the one for everything hear it."""
    heard: list[str] = []
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:

        def reply(query: zenoh.Query) -> None:
            with query:
                heard.append(str(query.parameters))
                query.reply(query.key_expr, b"x")

        server.declare_queryable(SERVICE, reply, complete=True)
        token = server.liveliness().declare_token(SERVER)
        wait_until(lambda: answers(asker, SERVICE, target=COMPLETE), "it is mirrored")
        heard.clear()
        for n in range(20):
            list(asker.get(f"{SERVICE}?n={n}", target=[COMPLETE, ALL, zenoh.QueryTarget.BEST_MATCHING][n % 3]))
        assert heard == [f"n={n}" for n in range(20)]
        del token


def test_local_queryables_are_not_hidden_by_those_of_the_other_side(tmp_path: Path) -> None:
    """A query gets replies from its own side too, and three sides answer together."""
    plan = plan_of(*(link(name, other) for name in ("a", "b", "c") for other in ("a", "b", "c") if name != other))
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("a") as asker,
        wire.program("a") as near,
        wire.program("b") as far,
        wire.program("c") as third,
    ):
        offer(near, "where/near", b"near")
        offer(far, "where/far", b"far")
        offer(third, "where/third", b"third")
        everywhere = [b"far", b"near", b"third"]
        wait_until(lambda: answers(asker, "where/*") == everywhere, "all answer")
        assert answers(asker, "where/*", target=ALL) == everywhere


def test_a_tap_carries_no_queries(tmp_path: Path) -> None:
    """Nor replies: a listener is not noticed. They go over the next link that takes their key."""
    plan = plan_of(
        link("robot", "base", tap=True, name="copy"),
        link("robot", "base"),
        link("base", "robot"),
        link("robot", "listener", tap=True),
    )
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot") as asker,
        wire.program("base") as base,
        wire.program("listener") as listener,
    ):
        offer(listener, "tap", b"no")
        offer(base, "base", b"yes")
        wait_until(lambda: answers(asker, "base"), "the base answers")
        assert not wire.fates("copy")
        assert not answers(asker, "tap")
        assert not answers(listener, "base")


@pytest.mark.parametrize(
    "settings", [{**PERFECT, "delay": {"model": "constant", "value": 0.05}}, {**PERFECT, "duplicate": 1.0}]
)
def test_delayed_and_doubled_queries_are_answered(tmp_path: Path, settings: dict[str, Any]) -> None:
    """A query waits for replies that are under way; of two equal replies the asker keeps one."""
    with (
        at_work(both_ways(settings, settings), tmp_path) as wire,
        wire.program("robot") as asker,
        wire.program("base") as server,
    ):
        offer(server, "map", b"x")
        assert wait_until(lambda: answers(asker, "map"), "it answers") == [b"x"]


def test_a_side_with_overlapping_keys_asks_each_query_once(tmp_path: Path) -> None:
    """A query that several of its key expressions hear belongs to the first of them, also one for many keys."""
    overlapping = Side("robot", (ANYWHERE,), keys=("map/**", "map/scan/**"))
    plan = plan_of(link("robot", "base"), link("base", "robot"), sides={"robot": overlapping})
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "map/scan/1", b"x")
        wait_until(lambda: answers(asker, "map/scan/1"), "the queryable is there")
        before = len(kinds(wire))
        for key in ("map/scan/1", "map/**", "map/scan/*"):
            assert answers(asker, key, consolidation=zenoh.ConsolidationMode.NONE) == [b"x"]
        assert kinds(wire)[before:] == [(Kind.QUERY, 0), (Kind.REPLY, 0)] * 3


def test_a_wildcard_over_hidden_keys_of_several_links_crosses_once(tmp_path: Path) -> None:
    """The wire listens to each of them apart, and these expressions have no key in common: a wildcard has, with each."""
    plan = plan_of(
        link("robot", "base", keys="a/@config/**", name="a"),
        link("robot", "base", keys="b/@config/**", name="b"),
        link("base", "robot", keys="*/@config/**"),
    )
    wildcard, written = "*/@config/x", []
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        offer(base, "a/@config/x", b"x")
        base.declare_subscriber(wildcard, lambda sample: written.append(sample.payload.to_bytes()))
        wait_until(lambda: answers(robot, "a/@config/x"), "the queryable is there")
        wait_until(lambda: robot.put("a/@config/x", b"first") or written, "the subscriber is there")
        before = len(kinds(wire))
        assert answers(robot, wildcard, consolidation=zenoh.ConsolidationMode.NONE) == [b"x"]
        assert kinds(wire)[before:] == [(Kind.QUERY, 0), (Kind.REPLY, 0)]
        robot.put(wildcard, b"all")
        robot.put("a/@config/x", b"last")
        wait_until(lambda: b"last" in written, "the last message crosses")
        assert written.count(b"all") == 1
        assert wire.rows_of(wildcard)["kind"].tolist() == [Kind.QUERY, Kind.PUT]


def test_the_end_of_the_time_for_replies_is_no_message(tmp_path: Path) -> None:
    """The asker gets Zenoh's error, whatever the link back does; in the journal, the next reply is the first."""
    held: list[zenoh.Query] = []
    with (
        at_work(both_ways(back=LOSSY, query_seconds=WAIT), tmp_path) as wire,
        wire.program("robot") as asker,
        wire.program("base") as server,
    ):
        server.declare_queryable("map", held.append)
        offer(server, "ready", b"x")
        wait_until(lambda: answers(asker, "ready"), "the queryables are there")
        before = len(kinds(wire))
        for n in range(5):
            replies = [*asker.get("map", timeout=60.0)]
            # Zenoh itself sometimes says it twice, in a session without a wire, too.
            assert {reply.err.payload.to_bytes() for reply in replies if reply.err is not None} == {b"Timeout"}
            assert len(held) == n + 1
        assert kinds(wire)[before:] == [(Kind.QUERY, 0)] * 5
        held.clear()


def test_a_query_was_heard_when_it_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although the queries before it kept the wire busy: the journal has that time, and its delay counts from it."""
    slow = {**PERFECT, "delay": {"model": "constant", "value": 1.5}}
    with at_work(both_ways(slow), tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "map", b"x")
        wait_until(lambda: answers(asker, "map"), "the queryable is there")
        ask = QueryRelay._ask

        def ask_late(relay: QueryRelay, asked: Any) -> None:
            time.sleep(1.0)
            ask(relay, asked)

        monkeypatch.setattr(QueryRelay, "_ask", ask_late)
        begun, came = time.time(), time.monotonic()
        assert answers(asker, "map") == [b"x"]
        assert time.monotonic() - came < 2.3
        (query,) = [row for row in wire.rows if row["kind"] == Kind.QUERY and row["time"] >= begun]
        assert query["time"] - begun < 0.8
