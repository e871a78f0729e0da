"""What a wire asks of Zenoh: the real one does so, and the simulated one, too."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.system.ports import free_port
from evedrop.system.world import world
from evedrop.virtual.run import SimulatedWorld
from tests.conftest import LIMIT

PUT, DELETE, BLOCK = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE, zenoh.CongestionControl.BLOCK
REMOTE = zenoh.Locality.REMOTE
Body = Callable[[Any, Callable[..., Any]], object]
"""Gets the session of a router, and what opens a client of it."""


def opened(mode: str, **entries: Any) -> Any:
    """A session that finds no others by itself."""
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    return world().zenoh.open(zenoh.Config.from_json5(json.dumps({"mode": mode, "scouting": scouting, **entries})))


def carry_out(body: Body) -> int:
    """A program that has all the sessions."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    sessions = [opened("router", listen={"endpoints": [endpoint]})]

    def client(mode: str = "client") -> Any:
        sessions.append(opened(mode, connect={"endpoints": [endpoint]}))
        return sessions[-1]

    try:
        body(sessions[0], client)
    finally:
        for session in sessions:
            session.close()
    return 0


def until(happened: Callable[[], object], what: str) -> None:
    """Wait until something has happened."""
    deadline = world().monotonic() + LIMIT
    while not happened():
        assert world().monotonic() < deadline, what
        world().sleep(0.01)


@pytest.fixture(params=["real", "simulated"])
def in_world(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[Body], None]:
    """Carries out a body in the real world, or in a simulated one."""

    def run(body: Body) -> None:
        if request.param == "real":
            carry_out(body)
            return
        simulated = SimulatedWorld(1, lambda _: 1, tmp_path)
        with simulated.entered():
            process = simulated.machine.begin("program", lambda: carry_out(body))
            simulated.scheduler.run(3600.0, lambda: not process.task.alive)
        for _, error in simulated.scheduler.errors:
            raise error

    return run


def test_messages_keep_what_they_carry(in_world: Callable[[Body], None]) -> None:
    """On the way from a client to the router, with a publisher and without; and a delete is none of them."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        got: list[Any] = []
        router.declare_subscriber("**", got.append, allowed_origin=REMOTE)
        session, how = client(), {"priority": zenoh.Priority.DATA_HIGH, "congestion_control": BLOCK, "express": True}
        publisher = session.declare_publisher("a", **how)
        until(lambda: publisher.matching_status.matching, "the client knows of the subscriber")
        session.put("a", b"one", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more", **how)
        publisher.put(b"two", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more")
        session.delete("a", **how)
        until(lambda: len(got) == 3, "all arrive")
        assert [(sample.kind, sample.payload.to_bytes()) for sample in got] == [
            (PUT, b"one"),
            (PUT, b"two"),
            (DELETE, b""),
        ]
        assert {str(sample.key_expr) for sample in got} == {"a"}
        for sample in got:
            assert (sample.priority, sample.congestion_control, sample.express) == (
                zenoh.Priority.DATA_HIGH,
                BLOCK,
                True,
            )
        for sample in got[:2]:
            assert sample.encoding == zenoh.Encoding.TEXT_PLAIN
            assert sample.attachment.to_bytes() == b"more"

    in_world(body)


def test_a_session_can_speak_to_others_only_and_hear_others_only(in_world: Callable[[Body], None]) -> None:
    """So a wire does not hear what it says itself."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        of_others: list[bytes] = []
        of_all: list[bytes] = []
        router.declare_subscriber(
            "**", lambda sample: of_others.append(sample.payload.to_bytes()), allowed_origin=REMOTE
        )
        router.declare_subscriber("**", lambda sample: of_all.append(sample.payload.to_bytes()))
        heard: list[bytes] = []
        session = client()
        session.declare_subscriber("a", lambda sample: heard.append(sample.payload.to_bytes()))
        until(lambda: router.declare_publisher("a", allowed_destination=REMOTE).matching_status.matching, "it is known")
        router.put("a", b"to others", allowed_destination=REMOTE)
        router.put("a", b"to all")
        session.put("b", b"from another")
        until(lambda: len(heard) == 2 and len(of_all) == 2 and of_others, "all arrive")
        assert (heard, of_others, of_all) == (
            [b"to others", b"to all"],
            [b"from another"],
            [b"to all", b"from another"],
        )

    in_world(body)


def test_a_querier_asks_others_only_until_they_answer_no_more(in_world: Callable[[Body], None]) -> None:
    """Its handler gets their answers, and is told of the end."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        asked: list[str] = []
        router.declare_queryable("**", lambda query: asked.append(str(query.key_expr)), allowed_origin=REMOTE)
        querier = router.declare_querier(
            "service", target=zenoh.QueryTarget.ALL, allowed_destination=REMOTE, timeout=LIMIT
        )
        assert not querier.matching_status.matching
        got: list[tuple[bytes, bytes]] = []

        def answer(query: Any) -> None:
            got.append((query.payload.to_bytes(), query.attachment.to_bytes()))
            query.reply("service", b"answer", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more")
            query.drop()

        session = client()
        queryable = session.declare_queryable("service", answer)
        until(lambda: querier.matching_status.matching, "the router knows of the queryable")
        replies: list[Any] = []
        over: list[bool] = []
        handler = world().zenoh.handlers.Callback(replies.append, lambda: over.append(True), indirect=False)
        querier.get(handler, payload=zenoh.ZBytes(b"question"), attachment=zenoh.ZBytes(b"with"))
        until(lambda: over, "the end is told")
        [reply] = [reply.ok for reply in replies]
        assert got == [(b"question", b"with")]
        assert (reply.payload.to_bytes(), reply.attachment.to_bytes()) == (b"answer", b"more")
        assert reply.encoding == zenoh.Encoding.TEXT_PLAIN
        assert asked == []
        queryable.undeclare()
        until(lambda: not querier.matching_status.matching, "the router knows that it is gone")
        querier.undeclare()

    in_world(body)


def test_a_router_knows_its_connections(in_world: Callable[[Body], None]) -> None:
    """Those that are there, and those that come and go; with their ids, and that they are clients."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        first = client()
        until(router.info.transports, "the first client is connected")
        events: list[tuple[Any, str]] = []
        links: list[tuple[Any, str]] = []
        listeners = [
            router.info.declare_transport_events_listener(
                lambda event: events.append((event.kind, str(event.transport.zid))), history=True
            ),
            router.info.declare_link_events_listener(
                lambda event: links.append((event.kind, str(event.link.zid))), history=True
            ),
        ]
        second = client()
        one, other = (str(session.info.zid()) for session in (first, second))
        until(lambda: len(events) == 2 and len(links) == 2, "both are known")
        assert {str(each.zid) for each in router.info.transports()} == {one, other}
        assert [each.whatami for each in router.info.transports()] == [zenoh.WhatAmI.CLIENT] * 2
        assert [str(each.zid) for each in first.info.transports()] == [str(router.info.zid())]
        assert [each.whatami for each in first.info.transports()] == [zenoh.WhatAmI.ROUTER]
        second.close()
        until(lambda: len(events) == 3 and len(links) == 3, "it has left")
        assert events == links == [(PUT, one), (PUT, other), (DELETE, other)]
        assert len(listeners) == 2

    in_world(body)


def test_liveliness_is_told_until_it_is_asked_no_more(in_world: Callable[[Body], None]) -> None:
    """Tokens that come and go; and whether one is there, by a handler that is told of the end."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        seen: list[tuple[str, Any]] = []

        def note(sample: Any) -> None:
            seen.append((str(sample.key_expr), sample.kind))

        handler = world().zenoh.handlers.Callback(note, indirect=True)
        subscriber = router.liveliness().declare_subscriber("**", handler, history=True)
        session = client()
        token = session.liveliness().declare_token("here")
        until(lambda: len(seen) == 1, "the token is seen")

        def there(key: str) -> bool:
            found: list[Any] = []
            over: list[bool] = []
            handler = world().zenoh.handlers.Callback(found.append, drop=lambda: over.append(True), indirect=False)
            router.liveliness().get(key, handler, timeout=LIMIT)
            until(lambda: over, "the end is told")
            return any(reply.ok is not None for reply in found)

        assert there("here")
        assert not there("elsewhere")
        token.undeclare()
        until(lambda: len(seen) == 2, "its end is seen")
        assert seen == [("here", PUT), ("here", DELETE)]
        subscriber.undeclare()
        token = session.liveliness().declare_token("here")
        until(lambda: there("here"), "it is there again")
        token.undeclare()
        until(lambda: not there("here"), "it is gone again")
        assert len(seen) == 2

    in_world(body)


@pytest.mark.thorough
def test_a_router_knows_a_peer_from_a_client(in_world: Callable[[Body], None]) -> None:
    """By its connection."""

    def body(router: Any, client: Callable[..., Any]) -> None:
        client(), client("peer")

        def modes() -> list[Any]:
            return [one.whatami for one in router.info.transports()]

        until(lambda: all(mode in modes() for mode in (zenoh.WhatAmI.CLIENT, zenoh.WhatAmI.PEER)), "both")

    in_world(body)
