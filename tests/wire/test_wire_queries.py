"""Queries and their replies cross a wire whole, or are lost for a reason that the journal states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.wire.crossing import Crossing, Kind
from tests.conftest import wait_until
from tests.wire.wire_at_work import DEAD, PERFECT, WireAtWork, at_work, both_ways, link, plan_of

COMPLETE = zenoh.QueryTarget.ALL_COMPLETE
ALL = zenoh.QueryTarget.ALL


def answers(session: zenoh.Session, key: str, **how: Any) -> list[bytes]:
    """The payloads of all replies without an error."""
    replies = session.get(key, **{"timeout": 5.0, **how})
    return sorted(one.ok.payload.to_bytes() for one in replies if one.ok is not None)


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
        put, delete = sorted((one.ok for one in replies if one.ok is not None), key=lambda one: str(one.key_expr))
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
        assert [(one.err.payload.to_bytes(), str(one.err.encoding)) for one in replies] == [(b"no", "text/plain")]


def test_nobody_waits_for_a_queryable_that_is_not_there(tmp_path: Path) -> None:
    """The asker is told at once that there are no replies, and no message is recorded."""
    with at_work(both_ways(DEAD), tmp_path) as wire, wire.program("robot") as asker:
        assert not list(asker.get("nobody/here", timeout=60.0))
        assert not kinds(wire)


def test_the_asker_of_a_lost_query_waits_and_a_lost_reply_is_missing(tmp_path: Path) -> None:
    """A lost query leaves its asker waiting for as long as the wire does; after a lost reply the asker goes on."""
    plan = plan_of(
        link("robot", "base", DEAD, "there/**", name="there"),
        link("robot", "base"),
        link("base", "robot", DEAD, "back/**", name="back"),
        link("base", "robot"),
        query_seconds=0.3,
    )
    with at_work(plan, tmp_path) as wire, wire.program("robot") as asker, wire.program("base") as server:
        offer(server, "there/1", b"x")
        offer(server, "back/1", b"x")
        offer(server, "ready", b"x")
        wait_until(lambda: answers(asker, "ready"), "the queryables are there")
        assert not list(asker.get("there/1", timeout=60.0))
        assert not list(asker.get("back/1", timeout=60.0))
        assert wire.fates("there") == [Crossing.LOST]
        assert wire.fates("back") == [Crossing.LOST]


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
    plan = plan_of(*(link(one, other) for one in ("a", "b", "c") for other in ("a", "b", "c") if one != other))
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
