"""What a wire asks of Zenoh: the real one does so, and the simulated one, too."""

from __future__ import annotations

from typing import Any

import pytest
import zenoh

from tests.conftest import LIMIT
from tests.virtual.networks import Network, behaviour

PUT, DELETE, BLOCK = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE, zenoh.CongestionControl.BLOCK
REMOTE = zenoh.Locality.REMOTE


@behaviour
def test_messages_keep_what_they_carry(net: Network) -> None:
    """On the way from a client to the router, with a publisher and without; and a delete is none of them."""
    router = net.router()
    got: list[Any] = []
    router.declare_subscriber("**", got.append, allowed_origin=REMOTE)
    session, how = (
        net.client("one"),
        {"priority": zenoh.Priority.DATA_HIGH, "congestion_control": BLOCK, "express": True},
    )
    publisher = session.declare_publisher("a", **how)
    net.until(lambda: publisher.matching_status.matching, "the client knows of the subscriber")
    session.put("a", b"one", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more", **how)
    publisher.put(b"two", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more")
    session.delete("a", **how)
    net.until(lambda: len(got) == 3, "all arrive")
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


@behaviour
def test_a_message_that_is_put_without_more_may_be_dropped(net: Network) -> None:
    """And so may what is deleted, and what a publisher puts."""
    router, got = net.router(), list[zenoh.Sample]()
    router.declare_subscriber("**", got.append)
    session = net.client("one")
    publisher = session.declare_publisher("b")
    net.until(lambda: publisher.matching_status.matching, "it is known")
    session.put("b", bytearray(b"one"))
    session.delete("b")
    publisher.put(b"two")
    net.until(lambda: len(got) == 3, "all arrive")
    assert [sample.payload.to_bytes() for sample in got] == [b"one", b"", b"two"]
    assert all(sample.congestion_control == zenoh.CongestionControl.DROP for sample in got)


@behaviour
def test_a_session_can_speak_to_others_only_and_hear_others_only(net: Network) -> None:
    """So a wire does not hear what it says itself."""
    router = net.router()
    of_others: list[bytes] = []
    of_all: list[bytes] = []
    router.declare_subscriber("**", lambda sample: of_others.append(sample.payload.to_bytes()), allowed_origin=REMOTE)
    router.declare_subscriber("**", lambda sample: of_all.append(sample.payload.to_bytes()))
    heard: list[bytes] = []
    session = net.client("one")
    session.declare_subscriber("a", lambda sample: heard.append(sample.payload.to_bytes()))
    net.until(lambda: router.declare_publisher("a", allowed_destination=REMOTE).matching_status.matching, "it is known")
    router.put("a", b"to others", allowed_destination=REMOTE)
    router.put("a", b"to all")
    session.put("b", b"from another")
    net.until(lambda: len(heard) == 2 and len(of_all) == 2 and of_others, "all arrive")
    assert (heard, of_others, of_all) == (
        [b"to others", b"to all"],
        [b"from another"],
        [b"to all", b"from another"],
    )


@behaviour
def test_a_querier_asks_others_only_until_they_answer_no_more(net: Network) -> None:
    """Its handler gets their answers, and is told of the end."""
    router = net.router()
    asked: list[str] = []
    router.declare_queryable("**", lambda query: asked.append(str(query.key_expr)), allowed_origin=REMOTE)
    querier = router.declare_querier("service", target=zenoh.QueryTarget.ALL, allowed_destination=REMOTE, timeout=LIMIT)
    assert not querier.matching_status.matching
    got: list[tuple[bytes, bytes]] = []

    def answer(query: Any) -> None:
        got.append((query.payload.to_bytes(), query.attachment.to_bytes()))
        query.reply("service", b"answer", encoding=zenoh.Encoding.TEXT_PLAIN, attachment=b"more")
        query.drop()

    session = net.client("one")
    queryable = session.declare_queryable("service", answer)
    net.until(lambda: querier.matching_status.matching, "the router knows of the queryable")
    replies: list[Any] = []
    over: list[bool] = []
    handler = net.zenoh.handlers.Callback(replies.append, lambda: over.append(True), indirect=False)
    querier.get(handler, payload=zenoh.ZBytes(b"question"), attachment=zenoh.ZBytes(b"with"))
    net.until(lambda: over, "the end is told")
    [reply] = [reply.ok for reply in replies]
    assert got == [(b"question", b"with")]
    assert (reply.payload.to_bytes(), reply.attachment.to_bytes()) == (b"answer", b"more")
    assert reply.encoding == zenoh.Encoding.TEXT_PLAIN
    assert asked == []
    queryable.undeclare()
    net.until(lambda: not querier.matching_status.matching, "the router knows that it is gone")
    querier.undeclare()


@behaviour
def test_a_router_knows_its_connections(net: Network) -> None:
    """Those that are there, and those that come and go; with their ids, and that they are clients.

    A link that the router opens just now may be told twice, as one that is there and as one that comes.
    """
    router = net.router()
    opened: list[Any] = []
    watching = router.info.declare_link_events_listener(opened.append, history=True)
    first = net.client("one")
    net.until(lambda: opened, "the first client is connected")
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
    second = net.client("other")
    one, other = (str(session.info.zid()) for session in (first, second))
    net.until(lambda: len(events) == 2 and len(links) == 2, "both are known")
    assert {str(each.zid) for each in router.info.transports()} == {one, other}
    assert [each.whatami for each in router.info.transports()] == [zenoh.WhatAmI.CLIENT] * 2
    assert [str(each.zid) for each in first.info.transports()] == [str(router.info.zid())]
    assert [each.whatami for each in first.info.transports()] == [zenoh.WhatAmI.ROUTER]
    second.close()
    net.until(lambda: len(events) == 3 and len(links) == 3, "it has left")
    assert events == links == [(PUT, one), (PUT, other), (DELETE, other)]
    assert len([watching, *listeners]) == 3


@behaviour
def test_liveliness_is_told_until_it_is_asked_no_more(net: Network) -> None:
    """Tokens that come and go; and whether one is there, by a handler that is told of the end."""
    router = net.router()
    seen: list[tuple[str, Any]] = []

    def note(sample: Any) -> None:
        seen.append((str(sample.key_expr), sample.kind))

    handler = net.zenoh.handlers.Callback(note, indirect=True)
    subscriber = router.liveliness().declare_subscriber("**", handler, history=True)
    session = net.client("one")
    token = session.liveliness().declare_token("here")
    net.until(lambda: len(seen) == 1, "the token is seen")

    def there(key: str) -> bool:
        found: list[Any] = []
        over: list[bool] = []
        handler = net.zenoh.handlers.Callback(found.append, drop=lambda: over.append(True), indirect=False)
        router.liveliness().get(key, handler, timeout=LIMIT)
        net.until(lambda: over, "the end is told")
        return any(reply.ok is not None for reply in found)

    assert there("here")
    assert not there("elsewhere")
    token.undeclare()
    net.until(lambda: len(seen) == 2, "its end is seen")
    assert seen == [("here", PUT), ("here", DELETE)]
    subscriber.undeclare()
    token = session.liveliness().declare_token("here")
    net.until(lambda: there("here"), "it is there again")
    token.undeclare()
    net.until(lambda: not there("here"), "it is gone again")
    assert len(seen) == 2


@pytest.mark.thorough
@behaviour
def test_a_router_knows_a_peer_from_a_client(net: Network) -> None:
    """By its connection."""
    router = net.router()
    net.client("one"), net.client("peer", peer=True)

    def modes() -> list[Any]:
        return [one.whatami for one in router.info.transports()]

    net.until(lambda: all(mode in modes() for mode in (zenoh.WhatAmI.CLIENT, zenoh.WhatAmI.PEER)), "both")
