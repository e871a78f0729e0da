"""The behaviours of Zenoh on which Evedrop relies: the real one has them, and the simulated one, too.

A version of Zenoh that behaves otherwise fails the test that has the behaviour's name.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from typing import Any

import pytest
import zenoh

from tests.virtual.networks import (
    ANSWERS,
    ASKS,
    CHECKS,
    READS,
    TOKEN,
    WATCHES,
    WRITES,
    WRONG,
    DeliberateError,
    Network,
    behaviour,
    granted,
    rights,
)

BLOCK, DROP = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
PUT, DELETE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
END = b"end"
ROUTING = 0
"""The number of Zenoh's routing among those who answer."""
Right = tuple[str, str, str]
USERS = ("writer", "reader")


def publisher(net: Network, session: Any, key: str, control: zenoh.CongestionControl = BLOCK) -> Any:
    """A publisher that knows of a reader."""
    declared = session.declare_publisher(key, congestion_control=control, reliability=zenoh.Reliability.RELIABLE)
    net.until(lambda: matches(declared), "reader of the key")
    return declared


def matches(declared: Any) -> bool:
    """Whether a publisher knows of a reader."""
    return bool(declared.matching_status.matching)


def channel(net: Network, session: Any, key: str, capacity: int = 10_000) -> Any:
    """A subscriber that keeps messages."""
    subscriber = session.declare_subscriber(key, net.zenoh.handlers.FifoChannel(capacity))
    net.kept.append(subscriber)
    return subscriber


def payloads(session: Any, key: str) -> list[bytes]:
    """A list that gets the payload of each message of a key."""
    got: list[bytes] = []
    session.declare_subscriber(key, lambda sample: got.append(sample.payload.to_bytes()))
    return got


def read(net: Network, subscriber: Any, count: int) -> list[bytes]:
    """The next messages of a subscriber."""
    got: list[bytes] = []

    def enough() -> bool:
        while len(got) < count and (sample := subscriber.try_recv()) is not None:
            got.append(sample.payload.to_bytes())
        return len(got) == count

    net.until(enough, f"{count} messages")
    return got


def watched(session: Any, key: str, history: bool = True) -> list[tuple[str, bool]]:
    """A list that gets each token of a key that comes (true) or goes."""
    seen: list[tuple[str, bool]] = []
    session.liveliness().declare_subscriber(
        key, lambda sample: seen.append((str(sample.key_expr), sample.kind == PUT)), history=history
    )
    return seen


def events(session: Any) -> list[zenoh.SampleKind]:
    """A list that gets what happens to the connections of a session."""
    happened: list[zenoh.SampleKind] = []
    session.info.declare_transport_events_listener(lambda event: happened.append(event.kind))
    return happened


def answers(session: Any, key: str, payload: bytes = b"?", timeout: float = 60.0) -> list[bytes]:
    """The answers to a question."""
    replies = session.get(key, payload=payload, timeout=timeout)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def present(session: Any, key: str, timeout: float = 60.0) -> list[str]:
    """The tokens that a question finds."""
    replies = session.liveliness().get(key, timeout=timeout)
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def wait_for_presence(net: Network, session: Any, key: str, count: int) -> None:
    """Wait until a question finds this many tokens."""
    net.until(lambda: len(present(session, key)) == count)


def wait_for_length(net: Network, items: list[Any], length: int) -> None:
    """Wait until a list has this length."""
    net.until(lambda: len(items) == length)


def connected(session: Any) -> bool:
    """Whether a session has a router."""
    return bool(session.info.routers_zid())


def pair(net: Network) -> tuple[Any, Any]:
    """A writer and a reader at one router."""
    net.router()
    return net.client("writer"), net.client("reader")


def line(net: Network, capacity: int = 10_000) -> tuple[Any, Any]:
    """A subscriber of a reader, and the publisher of a writer at the same router."""
    writer, reader = pair(net)
    return channel(net, reader, "a/b", capacity), publisher(net, writer, "a/b")


@contextmanager
def at_once(net: Network) -> Iterator[None]:
    """Expect that the block ends long before its limit."""
    began = net.now()
    yield
    assert net.now() - began < 60.0


# Messages


@behaviour
def test_messages_of_a_key_arrive_in_order(net: Network) -> None:
    """All of them, each once."""
    subscriber, put = line(net)
    sent = [str(number).encode() for number in range(500)]
    for payload in sent:
        put.put(payload)
    assert read(net, subscriber, 500) == sent
    assert subscriber.try_recv() is None


@behaviour
def test_messages_of_two_keys_of_one_writer_arrive_in_the_order_of_their_puts(net: Network) -> None:
    """As far as one reader with a wildcard sees them."""
    writer, reader = pair(net)
    subscriber = channel(net, reader, "a/*")
    one, other = publisher(net, writer, "a/b"), publisher(net, writer, "a/c")
    for number in range(100):
        (one if number % 2 else other).put(bytes([number]))
    assert read(net, subscriber, 100) == [bytes([number]) for number in range(100)]


@behaviour
def test_every_subscriber_of_a_key_gets_every_message(net: Network) -> None:
    """Those of one session, and those of several."""
    writer, reader = pair(net)
    other = net.client("other")
    subscribers = [channel(net, session, "a/b") for session in (reader, reader, other)]
    put = publisher(net, writer, "a/b")
    net.until(lambda: arrives(put, subscribers), "all subscribers to be known")
    put.put(b"one")
    put.put(END)
    for subscriber in subscribers:
        got = read_until(net, subscriber)
        assert got[-2:] == [b"one", END]


def arrives(put: Any, subscribers: list[Any]) -> bool:
    """Whether a message has come to all: each subscriber of another session is known at another time."""
    put.put(b"known?")
    return all(subscriber.try_recv() is not None for subscriber in subscribers)


def read_until(net: Network, subscriber: Any) -> list[bytes]:
    """All messages of a subscriber up to the last one."""
    got: list[bytes] = []
    while not got or got[-1] != END:
        got += read(net, subscriber, 1)
    return got


@behaviour
def test_a_ring_that_nobody_reads_forgets_the_oldest_messages_and_holds_nobody_up(net: Network) -> None:
    """The messages of other keys arrive meanwhile."""
    writer, reader = pair(net)
    ring = reader.declare_subscriber("a/b", net.zenoh.handlers.RingChannel(3))
    others = payloads(reader, "a/c")
    put, other = publisher(net, writer, "a/b"), publisher(net, writer, "a/c")
    for number in range(10):
        put.put(bytes([number]))
    other.put(b"one")
    wait_for_length(net, others, 1)
    assert read(net, ring, 3) == [b"\x07", b"\x08", b"\x09"]
    assert ring.try_recv() is None


@behaviour
def test_what_a_ring_has_kept_is_gone_with_its_session(net: Network) -> None:
    """Unlike what waits in a channel that holds up its session."""
    writer, reader = pair(net)
    ring, fifo = reader.declare_subscriber("a/b", net.zenoh.handlers.RingChannel(3)), channel(net, reader, "a/c")
    end = payloads(reader, "a/d")
    for key in ("a/b", "a/c", "a/d"):
        publisher(net, writer, key).put(b"one")
    wait_for_length(net, end, 1)
    reader.close()
    assert fifo.try_recv().payload.to_bytes() == b"one"
    for subscriber in (ring, fifo):
        with pytest.raises(zenoh.ZError):
            subscriber.try_recv()


@behaviour
def test_messages_of_two_writers_arrive_each_in_order(net: Network) -> None:
    """Whichever is first."""
    writer, reader = pair(net)
    other = net.client("other")
    subscriber = channel(net, reader, "a/b")
    puts = [publisher(net, session, "a/b") for session in (writer, other)]
    for number in range(100):
        for index, put in enumerate(puts):
            put.put(bytes([index, number]))
    got = read(net, subscriber, 200)
    for index in range(2):
        assert [payload[1] for payload in got if payload[0] == index] == [*range(100)]


@behaviour
def test_nothing_arrives_under_another_key(net: Network) -> None:
    """A subscriber of one key gets nothing of others."""
    writer, reader = pair(net)
    one, other = channel(net, reader, "a/b"), channel(net, reader, "a/c")
    put, end = publisher(net, writer, "a/b"), publisher(net, writer, "a/c")
    put.put(b"one")
    end.put(END)
    assert read(net, other, 1) == [END]
    assert other.try_recv() is None
    assert read(net, one, 1) == [b"one"]


@behaviour
def test_a_message_says_its_key_and_kind(net: Network) -> None:
    """Also to a subscriber with a wildcard."""
    writer, reader = pair(net)
    samples: list[Any] = []
    reader.declare_subscriber("a/**", samples.append)
    publisher(net, writer, "a/b/c").put(b"one")
    net.until(lambda: samples)
    assert (str(samples[0].key_expr), samples[0].kind) == ("a/b/c", PUT)


@behaviour
def test_a_star_stands_for_one_part_of_a_key(net: Network) -> None:
    """Not for none, and not for two."""
    writer, reader = pair(net)
    star, deep = channel(net, reader, "a/*"), channel(net, reader, "a/**")
    puts = [publisher(net, writer, key) for key in ("a", "a/b/c", "a/b")]
    for number, put in enumerate(puts):
        put.put(bytes([number]))
    assert read(net, deep, 3) == [b"\0", b"\1", b"\2"]
    assert read(net, star, 1) == [b"\2"]


@behaviour
def test_a_message_keeps_its_bytes(net: Network) -> None:
    """Of any length, also those that Zenoh sends in parts."""
    subscriber, put = line(net)
    for size in (0, 1, 255, 70_000, 1 << 20):
        payload = (bytes(range(256)) * (size // 256 + 1))[:size]
        put.put(payload)
        assert read(net, subscriber, 1) == [payload]


@behaviour
def test_a_subscription_gets_nothing_of_what_was_put_before_it(net: Network) -> None:
    """Zenoh keeps no messages."""
    writer, reader = pair(net)
    early = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    put.put(b"before")
    assert read(net, early, 1) == [b"before"]
    late = channel(net, reader, "a/b")
    put.put(END)
    assert read(net, late, 1) == [END]


@behaviour
def test_what_nobody_reads_is_no_error(net: Network) -> None:
    """Neither is it kept."""
    writer, reader = pair(net)
    put = writer.declare_publisher("a/b", congestion_control=BLOCK)
    marker = channel(net, reader, "marker")
    assert not matches(put)
    put.put(b"lost")
    publisher(net, writer, "marker").put(END)
    assert read(net, marker, 1) == [END]
    subscriber = channel(net, reader, "a/b")
    net.until(lambda: matches(put))
    put.put(END)
    assert read(net, subscriber, 1) == [END]


@behaviour
def test_a_router_reads_and_writes_as_its_clients_do(net: Network) -> None:
    """In both directions."""
    router = net.router()
    client = net.client("client")
    at_router, at_client = channel(net, router, "up"), channel(net, client, "down")
    publisher(net, client, "up").put(b"up")
    publisher(net, router, "down").put(b"down")
    assert (read(net, at_router, 1), read(net, at_client, 1)) == ([b"up"], [b"down"])


@behaviour
def test_a_session_reads_what_it_puts_itself(net: Network) -> None:
    """Evedrop's router wakes a thread of its own in this way."""
    router = net.router()
    client = net.client("client")
    for session, key in ((router, "a/b"), (client, "c/d")):
        subscriber = channel(net, session, key)
        publisher(net, session, key).put(b"own")
        assert read(net, subscriber, 1) == [b"own"]
        assert subscriber.try_recv() is None


@behaviour
def test_what_a_client_puts_comes_to_itself_once_when_others_read_it_too(net: Network) -> None:
    """The router does not send it back."""
    writer, reader = pair(net)
    own, far = channel(net, writer, "a/b"), channel(net, reader, "a/b")
    put = writer.declare_publisher("a/b", congestion_control=BLOCK)
    net.until(lambda: arrives(put, [far]))
    put.put(END)
    read_until(net, far)
    got = read_until(net, own)
    put.put(b"one")
    assert read(net, own, 1) == [b"one"]
    assert got.count(END) == 1


# Matching


@behaviour
def test_a_publisher_matches_while_there_is_a_reader(net: Network) -> None:
    """False, true, and false again."""
    writer, reader = pair(net)
    put = writer.declare_publisher("a/b")
    assert not matches(put)
    subscriber = channel(net, reader, "a/b")
    net.until(lambda: matches(put))
    subscriber.undeclare()
    net.until(lambda: not matches(put))


@behaviour
def test_a_publisher_matches_while_one_of_two_readers_is_there(net: Network) -> None:
    """The end of the other one changes nothing."""
    writer, reader = pair(net)
    put = writer.declare_publisher("a/b")
    first, second = channel(net, reader, "a/b"), channel(net, net.client("other"), "a/b")
    net.until(lambda: arrives(put, [first, second]))
    first.undeclare()
    marker = channel(net, reader, "marker")
    publisher(net, writer, "marker").put(END)
    read(net, marker, 1)
    assert matches(put)
    second.undeclare()
    net.until(lambda: not matches(put))


@behaviour
def test_a_publisher_for_others_does_not_match_a_reader_of_its_session(net: Network) -> None:
    """Any other publisher matches also one that is for messages of others, though that gets nothing."""
    remote = zenoh.Locality.REMOTE
    session = net.router()
    subscriber = session.declare_subscriber("a/b", net.zenoh.handlers.FifoChannel(10), allowed_origin=remote)
    put = session.declare_publisher("a/b")
    assert matches(put)
    assert not matches(session.declare_publisher("a/b", allowed_destination=remote))
    put.put(b"one")
    assert subscriber.try_recv() is None


@behaviour
def test_a_publisher_does_not_match_a_reader_of_another_key(net: Network) -> None:
    """Only one whose key expression has its key."""
    writer, reader = pair(net)
    channel(net, reader, "a/b"), channel(net, reader, "c/**")
    wrong, right = writer.declare_publisher("a/c"), writer.declare_publisher("c/d/e")
    net.until(lambda: matches(right))
    assert not matches(wrong)


@behaviour
def test_a_publisher_matches_no_longer_when_its_reader_closes(net: Network) -> None:
    """Without a word of the subscriber."""
    writer, reader = pair(net)
    channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    reader.close()
    net.until(lambda: not matches(put))


@behaviour
def test_a_publisher_matches_no_longer_when_its_reader_is_killed(net: Network) -> None:
    """Before any lease is over, as the system closes the connection."""
    net.router()
    writer = net.client("writer")
    net.child("reader", [("subscriber", "a/b")])
    put = publisher(net, writer, "a/b")
    net.kill("reader")
    net.until(lambda: not matches(put))


@behaviour
def test_a_publisher_without_a_router_matches_nobody(net: Network) -> None:
    """Once the connection is lost."""
    net.router()
    writer, reader = net.client("writer", cable=True), net.client("reader")
    channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    net.cut("writer")
    net.until(lambda: not matches(put))


# What subscribers are


@behaviour
def test_a_channel_without_messages_gives_none(net: Network) -> None:
    """It does not wait."""
    net.router()
    assert channel(net, net.client("reader"), "a/b").try_recv() is None


@behaviour
def test_a_reader_waits_for_the_next_message(net: Network) -> None:
    """Until it arrives."""
    writer, reader = pair(net)
    subscriber = channel(net, reader, "a/b")
    got: list[bytes] = []
    thread = net.thread(lambda: got.append(subscriber.recv().payload.to_bytes()))
    publisher(net, writer, "a/b").put(b"one")
    net.until(lambda: got)
    thread.join(60.0)
    assert got == [b"one"]


@behaviour
def test_an_undeclared_subscriber_gets_nothing_more(net: Network) -> None:
    """Others do."""
    writer, reader = pair(net)
    got: list[bytes] = []
    one = reader.declare_subscriber("a/b", lambda sample: got.append(sample.payload.to_bytes()))
    other = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    put.put(b"one")
    assert read(net, other, 1) == [b"one"]
    net.until(lambda: got)
    one.undeclare()
    put.put(b"two")
    assert read(net, other, 1) == [b"two"]
    assert got == [b"one"]


@pytest.mark.thorough
@behaviour
def test_a_channel_that_has_no_room_holds_back_its_sender_and_loses_nothing(net: Network) -> None:
    """If the sender blocks. It sends more than can be under way."""
    subscriber, put = line(net, capacity=1)
    sent: list[int] = []

    def send() -> None:
        for number in range(_MANY):
            put.put(number.to_bytes(2, "big") + _LONG)
            sent.append(number)

    thread = net.thread(send)
    standstill(net, lambda: len(sent))
    assert len(sent) < _MANY
    got = [int.from_bytes(payload[:2], "big") for payload in read(net, subscriber, _MANY)]
    thread.join(60.0)
    assert got == [*range(_MANY)]


_LONG = bytes(1 << 20)
_MANY = 60


def standstill(net: Network, count: Any) -> None:
    """Wait until something no longer changes, for a second."""
    before = -1
    while (now := count()) != before or not now:
        before = now
        net.pause(1.0)


@behaviour
def test_a_sender_that_drops_loses_messages_when_the_reader_stands_still(net: Network) -> None:
    """It does not wait; the reader gets the first ones, and later ones once there is room."""
    writer, reader = pair(net)
    subscriber = channel(net, reader, "a/b", capacity=1)
    put = publisher(net, writer, "a/b", DROP)
    for number in range(_MANY):
        put.put(number.to_bytes(2, "big") + _LONG)
    put_end = publisher(net, writer, "a/b", BLOCK)
    thread = net.thread(lambda: put_end.put(END))
    got = read_until(net, subscriber)[:-1]
    thread.join(60.0)
    numbers = [int.from_bytes(payload[:2], "big") for payload in got]
    assert 0 < len(numbers) < _MANY
    assert all(one < other for one, other in pairwise(numbers))


@pytest.mark.thorough
@behaviour
def test_a_sender_that_has_waited_for_room_closes_the_connection(net: Network) -> None:
    """After `wait_before_close`; then what is put is lost, without an error."""
    net.router(patience=0.3)
    writer, reader = net.client("writer"), net.client("reader")
    subscriber = channel(net, reader, "a/b", capacity=1)
    put = publisher(net, writer, "a/b")
    for _ in range(_MANY):
        put.put(_LONG)
    net.until(lambda: not matches(put), "the reader to be dropped")
    assert connected(writer)
    put.put(END)
    subscriber.undeclare()


@behaviour
def test_callbacks_get_messages_one_after_the_other_and_in_order(net: Network) -> None:
    """The next one waits until the function has returned."""
    writer, reader = pair(net)
    steps: list[tuple[str, bytes]] = []
    entered, go_on = net.event(), net.event()

    def take(sample: Any) -> None:
        steps.append(("begin", sample.payload.to_bytes()))
        entered.set()
        go_on.wait(60.0)
        steps.append(("end", sample.payload.to_bytes()))

    reader.declare_subscriber("a/b", take)
    put = publisher(net, writer, "a/b")
    for payload in (b"1", b"2", b"3"):
        put.put(payload)
    entered.wait(60.0)
    go_on.set()
    net.until(lambda: len(steps) == 6)
    assert steps == [(what, payload) for payload in (b"1", b"2", b"3") for what in ("begin", "end")]


class Obstacle:
    """A function that does not return until it is told to."""

    def __init__(self, net: Network) -> None:
        self.entered, self.go_on = net.event(), net.event()
        self.left = False

    def __call__(self, _: object) -> None:
        """Stand still."""
        self.entered.set()
        self.go_on.wait(1000.0)
        self.left = True


def stand_still(net: Network, session: Any, key: str) -> Obstacle:
    """Let a message of a key stop the function that takes it."""
    obstacle = Obstacle(net)
    session.declare_subscriber(key, obstacle)
    return obstacle


@behaviour
def test_a_slow_callback_does_not_delay_other_sessions(net: Network) -> None:
    """They have threads of their own."""
    writer, reader = pair(net)
    obstacle = stand_still(net, reader, "a/b")
    other = channel(net, net.client("other"), "c/d")
    slow, quick = publisher(net, writer, "a/b"), publisher(net, writer, "c/d")
    slow.put(b"one")
    net.until(obstacle.entered.is_set)
    quick.put(b"two")
    assert read(net, other, 1) == [b"two"]
    assert not obstacle.left
    obstacle.go_on.set()


@behaviour
def test_a_slow_callback_does_not_delay_other_callbacks_of_its_session(net: Network) -> None:
    """Each has a thread of its own, on which its messages wait."""
    writer, reader = pair(net)
    obstacle = stand_still(net, reader, "a/b")
    other = payloads(reader, "c/d")
    slow, quick = publisher(net, writer, "a/b"), publisher(net, writer, "c/d")
    slow.put(b"one")
    net.until(obstacle.entered.is_set)
    quick.put(b"two")
    net.until(lambda: other == [b"two"])
    assert not obstacle.left
    obstacle.go_on.set()


@behaviour
def test_a_direct_callback_is_called_before_a_put_of_its_session_returns(net: Network) -> None:
    """On its thread; any other callback has one of its own."""
    session = net.router()
    steps: list[str] = []
    session.declare_subscriber("a/b", net.zenoh.handlers.Callback(lambda _: steps.append("taken"), indirect=False))
    session.put("a/b", b"one")
    steps.append("put")
    assert steps == ["taken", "put"]


@behaviour
def test_a_handler_is_told_of_the_end(net: Network) -> None:
    """When it is undeclared, and when its session is closed; after its last message."""
    session = net.router()
    heard: list[str] = []

    def noting(name: str) -> Any:
        return net.zenoh.handlers.Callback(
            lambda sample: heard.append(f"{name} {sample.payload.to_string()}"), lambda: heard.append(f"{name} ends")
        )

    one = session.declare_subscriber("a/one", noting("one"))
    net.kept.append(session.declare_subscriber("a/other", noting("other")))
    session.put("a/one", b"1")
    session.put("a/other", b"2")
    one.undeclare()
    net.until(lambda: "one ends" in heard and "other 2" in heard)
    assert "other ends" not in heard
    session.close()
    net.until(lambda: "other ends" in heard)
    assert [what for what in heard if "one" in what] == ["one 1", "one ends"]
    assert [what for what in heard if "other" in what] == ["other 2", "other ends"]


@behaviour
def test_an_exception_in_a_callback_loses_only_its_message(net: Network) -> None:
    """The next ones arrive there, and at others."""
    writer, reader = pair(net)
    got: list[bytes] = []

    def take(sample: Any) -> None:
        payload = sample.payload.to_bytes()
        if payload == b"1":
            raise DeliberateError
        got.append(payload)

    reader.declare_subscriber("a/b", take)
    other = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    for payload in (b"1", b"2"):
        put.put(payload)
    net.until(lambda: got == [b"2"])
    assert read(net, other, 2) == [b"1", b"2"]


# The end of a session


@behaviour
def test_a_session_is_open_until_it_is_closed(net: Network) -> None:
    """And then for ever closed; to close it again is no error."""
    net.router()
    client = net.client("client")
    assert not client.is_closed()
    client.close()
    assert client.is_closed()
    client.close()


@behaviour
def test_a_closed_session_puts_nothing(net: Network) -> None:
    """Its publishers raise ZError."""
    writer, reader = pair(net)
    channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    writer.close()
    with pytest.raises(zenoh.ZError):
        put.put(b"one")


@behaviour
def test_a_closed_session_declares_and_asks_nothing(net: Network) -> None:
    """It raises ZError."""
    net.router()
    client = net.client("client")
    liveliness = client.liveliness()
    client.close()
    attempts: list[Callable[[], object]] = [
        lambda: channel(net, client, "a/b"),
        lambda: client.declare_publisher("a/b"),
        lambda: client.declare_queryable("a/b", lambda _: None),
        lambda: liveliness.declare_token("a/b"),
        lambda: liveliness.declare_subscriber("a/b", lambda _: None),
        lambda: client.get("a/b", timeout=1.0),
        lambda: liveliness.get("a/b", timeout=1.0),
    ]
    for attempt in attempts:
        with pytest.raises(zenoh.ZError):
            attempt()


@behaviour
def test_what_has_arrived_can_be_read_after_the_end_of_the_session(net: Network) -> None:
    """Then the channel raises ZError."""
    writer, reader = pair(net)
    subscriber = channel(net, reader, "a/b")
    marker = payloads(reader, "marker")
    put = publisher(net, writer, "a/b")
    for payload in (b"1", b"2"):
        put.put(payload)
    publisher(net, writer, "marker").put(END)
    net.until(lambda: marker)
    reader.close()
    assert [subscriber.try_recv().payload.to_bytes() for _ in range(2)] == [b"1", b"2"]
    with pytest.raises(zenoh.ZError):
        subscriber.try_recv()
    with pytest.raises(zenoh.ZError):
        subscriber.recv()


@behaviour
def test_the_end_of_a_session_wakes_up_its_readers(net: Network) -> None:
    """They get ZError."""
    net.router()
    reader = net.client("reader")
    subscriber = channel(net, reader, "a/b")
    waiting, errors = net.event(), list[Exception]()

    def wait() -> None:
        waiting.set()
        try:
            subscriber.recv()
        except zenoh.ZError as error:
            errors.append(error)

    thread = net.thread(wait)
    waiting.wait(60.0)
    reader.close()
    thread.join(60.0)
    assert len(errors) == 1


@behaviour
def test_what_was_put_before_the_end_of_a_session_arrives(net: Network) -> None:
    """It is sent before the connection is closed."""
    writer, reader = pair(net)
    subscriber = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    for number in range(100):
        put.put(bytes([number]))
    writer.close()
    assert read(net, subscriber, 100) == [bytes([number]) for number in range(100)]


# Liveliness


@behaviour
def test_a_token_is_seen_by_who_watches_already(net: Network) -> None:
    """Once."""
    shower, watcher = pair(net)
    seen = watched(watcher, "alive/*")
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: seen)
    assert seen == [("alive/a", True)]


@behaviour
def test_a_token_is_seen_by_who_watches_later_with_history(net: Network) -> None:
    """Also if it is an older one."""
    shower, watcher = pair(net)
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: present(watcher, "alive/a"))
    seen = watched(watcher, "alive/a")
    net.until(lambda: seen == [("alive/a", True)])


@behaviour
def test_a_token_is_not_seen_by_who_watches_later_without_history(net: Network) -> None:
    """Who sees only what changes."""
    shower, watcher = pair(net)
    token = shower.liveliness().declare_token("alive/a")
    net.until(lambda: present(watcher, "alive/a"))
    seen = watched(watcher, "alive/*", history=False)
    present(watcher, "alive/a")  # the answer comes after the router knows that it is watched
    net.kept.append(shower.liveliness().declare_token("alive/b"))
    net.until(lambda: ("alive/b", True) in seen)
    token.undeclare()
    net.until(lambda: ("alive/a", False) in seen)
    assert seen == [("alive/b", True), ("alive/a", False)]


def settled(net: Network, other: Any, *seen: list[tuple[str, bool]]) -> None:
    """Wait until the router has told everything to those who watch "alive/*": another session shows a token after it."""
    token = other.liveliness().declare_token("alive/settled")
    net.until(lambda: all(("alive/settled", True) in events for events in seen))
    token.undeclare()
    net.until(lambda: all(("alive/settled", False) in events for events in seen))
    for events in seen:
        events[:] = [event for event in events if event[0] != "alive/settled"]


@behaviour
def test_a_token_is_seen_by_its_own_session(net: Network) -> None:
    """As by others."""
    client, other = pair(net)
    seen = watched(client, "alive/*"), watched(other, "alive/*")
    settled(net, other, *seen)
    token = client.liveliness().declare_token("alive/a")
    net.until(lambda: all(seen))
    settled(net, other, *seen)
    token.undeclare()
    net.until(lambda: seen == ([("alive/a", True), ("alive/a", False)],) * 2)


@behaviour
def test_a_token_that_is_withdrawn_at_once_may_be_seen_twice_by_its_own_session(net: Network) -> None:
    """What the router tells of it may come when it is gone."""
    client, other = pair(net)
    seen = watched(client, "alive/*"), watched(other, "alive/*")
    settled(net, other, *seen)
    client.liveliness().declare_token("alive/a").undeclare()
    net.until(lambda: seen[1] == [("alive/a", True), ("alive/a", False)])
    settled(net, other, *seen)
    assert seen[0].count(("alive/a", True)) == seen[0].count(("alive/a", False)) in {1, 2}
    assert seen[0][-1] == ("alive/a", False)


@behaviour
def test_a_token_of_two_sessions_ends_with_the_second_for_both(net: Network) -> None:
    """Neither is told when the other one withdraws it first."""
    sessions = pair(net)
    seen = watched(sessions[0], "alive/*"), watched(sessions[1], "alive/*")
    settled(net, sessions[1], *seen)
    tokens = []
    for session in sessions:
        tokens.append(session.liveliness().declare_token("alive/a"))
        net.until(lambda: all(seen))
        settled(net, session, *seen)
    for session, token in zip(sessions, tokens, strict=True):
        token.undeclare()
        settled(net, session, *seen)
    assert seen == ([("alive/a", True), ("alive/a", False)],) * 2


@behaviour
def test_a_session_that_watches_later_without_history_sees_the_end_of_its_own_token_twice(net: Network) -> None:
    """Once from itself and once from the router."""
    client, other = pair(net)
    token = client.liveliness().declare_token("alive/a")
    net.until(lambda: present(other, "alive/a"))
    seen = watched(client, "alive/*", history=False)
    present(client, "alive/nobody")  # the answer comes after the router knows that it is watched
    token.undeclare()
    net.until(lambda: seen == [("alive/a", False), ("alive/a", False)])


@behaviour
def test_a_router_sees_tokens(net: Network) -> None:
    """And clients see its own."""
    router = net.router()
    client = net.client("client")
    seen = watched(router, "alive/client"), watched(client, "alive/router")
    net.kept += [
        session.liveliness().declare_token(key) for session, key in ((client, "alive/client"), (router, "alive/router"))
    ]
    net.until(lambda: seen == ([("alive/client", True)], [("alive/router", True)]))


@behaviour
def test_a_router_that_holds_a_token_does_not_see_another_one_of_its_key(net: Network) -> None:
    """A question finds one token, whoever holds it: the router cannot know."""
    router = net.router()
    client = net.client("client")
    seen = watched(router, "alive/*")
    net.kept.append(router.liveliness().declare_token("alive/a"))
    net.kept += [client.liveliness().declare_token(key) for key in ("alive/a", "alive/end")]
    net.until(lambda: ("alive/end", True) in seen)
    assert seen.count(("alive/a", True)) == 1
    assert present(router, "alive/a") == ["alive/a"]


@behaviour
def test_two_watchers_of_a_session_both_see_a_token(net: Network) -> None:
    """Each once."""
    shower, watcher = pair(net)
    one, other = watched(watcher, "alive/a"), watched(watcher, "alive/*")
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: one and other)
    assert one == other == [("alive/a", True)]


@behaviour
def test_a_token_is_told_to_each_watcher_once(net: Network) -> None:
    """Also if another one, which wants to know what is there already, comes later."""
    shower, watcher = pair(net)
    seen = watched(watcher, "alive/*")
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: seen)
    later = watched(watcher, "alive/*")
    net.until(lambda: later)
    net.kept.append(shower.liveliness().declare_token("alive/end"))
    net.until(lambda: ("alive/end", True) in seen and ("alive/end", True) in later)
    assert seen == later == [("alive/a", True), ("alive/end", True)]


@behaviour
def test_a_token_cannot_be_undeclared_twice(net: Network) -> None:
    """The second time, it raises ZError, and another one of the same key stays."""
    session = net.router()
    first, second = (session.liveliness().declare_token("alive/a") for _ in range(2))
    first.undeclare()
    with pytest.raises(zenoh.ZError):
        first.undeclare()
    assert present(session, "alive/a") == ["alive/a"]
    second.undeclare()
    assert present(session, "alive/a") == []


@behaviour
def test_a_watcher_that_is_undeclared_sees_nothing_more(net: Network) -> None:
    """Others of its session do."""
    shower, watcher = pair(net)
    seen: list[str] = []
    one = watcher.liveliness().declare_subscriber(
        "alive/*", lambda sample: seen.append(str(sample.key_expr)), history=True
    )
    other = watched(watcher, "alive/*")
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: seen and other)
    one.undeclare()
    net.kept.append(shower.liveliness().declare_token("alive/b"))
    net.until(lambda: ("alive/b", True) in other)
    assert seen == ["alive/a"]


@behaviour
def test_a_token_goes_when_it_is_undeclared(net: Network) -> None:
    """And comes again when it is declared again."""
    shower, watcher = pair(net)
    seen = watched(watcher, "alive/a")
    token = shower.liveliness().declare_token("alive/a")
    net.until(lambda: len(seen) == 1)
    token.undeclare()
    net.until(lambda: len(seen) == 2)
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: len(seen) == 3)
    assert seen == [("alive/a", True), ("alive/a", False), ("alive/a", True)]


@behaviour
def test_a_token_goes_when_its_session_closes(net: Network) -> None:
    """Without a word of its own."""
    shower, watcher = pair(net)
    seen = watched(watcher, "alive/a")
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: len(seen) == 1)
    shower.close()
    net.until(lambda: seen == [("alive/a", True), ("alive/a", False)])


@behaviour
def test_a_token_goes_when_its_process_is_killed(net: Network) -> None:
    """And comes again with the next one."""
    net.router()
    seen = watched(net.client("watcher"), "alive/a")
    for count in (1, 3):
        net.child("shower", [("token", "alive/a")], lease=100.0)
        wait_for_length(net, seen, count)
        net.kill("shower")
        wait_for_length(net, seen, count + 1)
    assert seen == [("alive/a", True), ("alive/a", False)] * 2


@pytest.mark.thorough
@behaviour
def test_a_token_goes_after_the_lease_of_a_suspended_process(net: Network) -> None:
    """And comes again when it goes on and connects again."""
    net.router(lease=1.0)
    seen = watched(net.client("watcher"), "alive/a")
    net.child("shower", [("token", "alive/a")], lease=1.0, retry=True)
    net.until(lambda: len(seen) == 1)
    net.suspend("shower")
    net.until(lambda: seen == [("alive/a", True), ("alive/a", False)])
    net.resume("shower")
    net.until(lambda: seen == [("alive/a", True), ("alive/a", False), ("alive/a", True)])


@behaviour
def test_a_token_stays_when_its_process_is_suspended_for_less_than_the_lease(net: Network) -> None:
    """Nobody notices."""
    net.router()
    watcher = net.client("watcher")
    seen = watched(watcher, "alive/*")
    net.child("shower", [("token", "alive/a")], lease=100.0)
    net.until(lambda: len(seen) == 1)
    net.suspend("shower")
    net.pause(0.5)
    net.resume("shower")
    net.kept.append(watcher.liveliness().declare_token("alive/b"))
    net.until(lambda: len(seen) == 2)
    assert seen == [("alive/a", True), ("alive/b", True)]


@behaviour
def test_a_question_finds_the_tokens_that_are_there(net: Network) -> None:
    """Those of its keys."""
    net.router()
    one, other, asker = (net.client(name) for name in ("one", "other", "asker"))
    net.kept.append(one.liveliness().declare_token("alive/one"))
    token = other.liveliness().declare_token("alive/other")
    net.until(lambda: present(asker, "alive/*") == ["alive/one", "alive/other"])
    assert present(asker, "alive/other") == ["alive/other"]
    token.undeclare()
    net.until(lambda: present(asker, "alive/*") == ["alive/one"])


@behaviour
def test_a_question_finds_a_token_of_its_own_session_twice(net: Network) -> None:
    """The session answers, and the router does."""
    net.router()
    asker = net.client("asker")
    token = asker.liveliness().declare_token("alive/asker")
    net.until(lambda: present(asker, "alive/*") == ["alive/asker", "alive/asker"])
    token.undeclare()
    net.until(lambda: present(asker, "alive/*") == [])


@behaviour
def test_a_question_for_a_token_that_is_not_there_ends_at_once(net: Network) -> None:
    """Without an answer, long before its limit."""
    net.router()
    asker = net.client("asker")
    with at_once(net):
        assert present(asker, "alive/nobody", timeout=1000.0) == []


@behaviour
def test_two_tokens_of_one_key_are_seen_as_one(net: Network) -> None:
    """It goes with the last one."""
    one, watcher = pair(net)
    other = net.client("other")
    seen = watched(watcher, "alive/*")
    tokens = [session.liveliness().declare_token("alive/a") for session in (one, other)]
    net.kept.append(other.liveliness().declare_token("alive/marker"))
    net.until(lambda: ("alive/marker", True) in seen and ("alive/a", True) in seen)
    tokens[0].undeclare()
    net.kept.append(one.liveliness().declare_token("alive/end"))
    net.until(lambda: ("alive/end", True) in seen)
    assert ("alive/a", False) not in seen
    tokens[1].undeclare()
    net.until(lambda: seen[-1] == ("alive/a", False))
    assert seen.count(("alive/a", True)) == 1


# Lost connections


@behaviour
def test_a_client_without_a_router_fails_to_open(net: Network) -> None:
    """At once, with ZError."""
    with at_once(net), pytest.raises(zenoh.ZError):
        net.client("client")


@behaviour
def test_a_second_router_at_one_endpoint_fails_to_open(net: Network) -> None:
    """With ZError; the first one stays."""
    net.router()
    config = net.zenoh.Config.from_json5(json.dumps(net.config("router", router=True)))
    with pytest.raises(zenoh.ZError):
        net.zenoh.open(config)
    assert connected(net.client("client"))


@behaviour
def test_a_client_knows_the_id_of_its_router(net: Network) -> None:
    """And each session has another one."""
    router = net.router()
    one, other = net.client("one"), net.client("other")
    assert [str(zid) for zid in one.info.routers_zid()] == [str(router.info.zid())]
    assert len({str(session.info.zid()) for session in (router, one, other)}) == 3


@behaviour
def test_a_router_can_be_given_its_id(net: Network) -> None:
    """As its clients see."""
    net.router(zid="abc123")
    assert [str(zid) for zid in net.client("client").info.routers_zid()] == ["abc123"]


@behaviour
def test_a_router_that_is_started_again_has_another_id(net: Network) -> None:
    """At the same endpoint."""
    net.child("router", [], router=True, to=None)
    first = str(net.client("one").info.routers_zid()[0])
    net.kill("router")
    net.child("router", [], router=True, to=None)
    assert str(net.client("other").info.routers_zid()[0]) != first


@behaviour
def test_a_session_that_does_not_reconnect_stays_open_without_a_router(net: Network) -> None:
    """It learns of the loss once, and has no router from then on."""
    net.router()
    client = net.client("client", cable=True)
    lost = events(client)
    assert connected(client)
    net.cut("client")
    net.until(lambda: lost)
    assert not connected(client)
    assert not client.is_closed()
    assert lost == [DELETE]


@behaviour
def test_a_client_may_wait_for_its_router_while_it_opens(net: Network) -> None:
    """For as long as its configuration says."""
    opened: list[Any] = []
    net.thread(lambda: opened.append(net.client("client", retry=True, timeout_ms=60_000)))
    net.pause(0.2)
    assert not opened
    net.router()
    net.until(lambda: opened)
    assert connected(opened[0])


@behaviour
def test_a_session_may_reconnect_at_once_whatever_its_retry(net: Network) -> None:
    """Its first attempt does not wait; it fails if the router has not noticed the loss yet, and then there is no other."""
    net.router()

    def reconnects() -> bool:
        client = net.client("client", cable=True)
        happened = events(client)
        net.flap("client")
        net.until(lambda: happened)
        net.pause(0.2)
        client.close()
        return happened[:2] == [DELETE, PUT]

    net.until(reconnects)


@behaviour
def test_what_is_put_without_a_router_is_lost_without_an_error(net: Network) -> None:
    """Whether the publisher blocks or drops."""
    net.router()
    writer, reader = net.client("writer", cable=True, retry=True), net.client("reader")
    subscriber = channel(net, reader, "a/b")
    puts = [publisher(net, writer, "a/b", control) for control in (BLOCK, DROP)]
    net.cut("writer")
    net.until(lambda: not connected(writer))
    for put in puts:
        put.put(b"lost")
    net.heal("writer")
    net.until(lambda: matches(puts[0]))
    puts[0].put(END)
    assert read(net, subscriber, 1) == [END]


@behaviour
def test_what_is_under_way_when_a_connection_is_cut_is_lost(net: Network) -> None:
    """What has arrived before can still be read, until the session is closed and all is read."""
    net.router()
    writer, reader = net.client("writer"), net.client("reader", cable=True)
    subscriber, marker = channel(net, reader, "a/b"), payloads(reader, "a/b")
    put = publisher(net, writer, "a/b")
    put.put(b"arrives")
    net.until(lambda: marker)
    net.silence("reader")
    put.put(b"lost")
    net.cut("reader")
    net.until(lambda: not connected(reader))
    assert read(net, subscriber, 1) == [b"arrives"]
    assert subscriber.try_recv() is None
    reader.close()
    with pytest.raises(zenoh.ZError):
        subscriber.recv()


@behaviour
def test_a_session_that_reconnects_reads_again(net: Network) -> None:
    """Its subscribers get what is put from then on."""
    net.router()
    writer, reader = net.client("writer"), net.client("reader", cable=True, retry=True)
    subscriber = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    happened = events(reader)
    net.cut("reader")
    net.until(lambda: happened == [DELETE])
    net.until(lambda: not matches(put))
    put.put(b"lost")
    net.heal("reader")
    net.until(lambda: happened == [DELETE, PUT])
    net.until(lambda: matches(put))
    put.put(b"one")
    assert read(net, subscriber, 1) == [b"one"]


@behaviour
def test_a_session_that_reconnects_shows_its_token_again(net: Network) -> None:
    """Others see it go and come."""
    net.router()
    seen = watched(net.client("watcher"), "alive/a")
    shower = net.client("shower", cable=True, retry=True)
    net.kept.append(shower.liveliness().declare_token("alive/a"))
    net.until(lambda: len(seen) == 1)
    net.cut("shower")
    net.until(lambda: len(seen) == 2)
    net.heal("shower")
    net.until(lambda: len(seen) == 3)
    assert seen == [("alive/a", True), ("alive/a", False), ("alive/a", True)]


@behaviour
def test_a_watcher_that_loses_its_router_sees_all_tokens_go(net: Network) -> None:
    """And come when it is connected again."""
    net.router()
    watcher = net.client("watcher", cable=True, retry=True)
    seen = watched(watcher, "alive/a")
    net.kept.append(net.client("shower").liveliness().declare_token("alive/a"))
    net.until(lambda: len(seen) == 1)
    net.cut("watcher")
    net.until(lambda: len(seen) == 2)
    net.heal("watcher")
    net.until(lambda: len(seen) == 3)
    assert seen == [("alive/a", True), ("alive/a", False), ("alive/a", True)]


@behaviour
def test_the_clients_of_a_killed_router_notice(net: Network) -> None:
    """All of them, before any lease is over."""
    net.child("router", [], router=True, to=None)
    clients = [net.client(name) for name in ("one", "other")]
    lost = [events(client) for client in clients]
    net.kill("router")
    net.until(lambda: all(lost))
    assert not any(connected(client) for client in clients)


@behaviour
def test_the_clients_of_a_closed_router_notice(net: Network) -> None:
    """As of a killed one."""
    router = net.router()
    client = net.client("client")
    lost = events(client)
    router.close()
    net.until(lambda: lost == [DELETE])
    assert not connected(client)


@pytest.mark.thorough
@behaviour
def test_the_clients_of_a_suspended_router_notice_after_the_lease(net: Network) -> None:
    """Of their own."""
    net.child("router", [], router=True, to=None, lease=1.0)
    client = net.client("client", lease=1.0)
    lost = events(client)
    net.suspend("router")
    net.until(lambda: lost == [DELETE])


@behaviour
def test_clients_that_reconnect_find_a_router_that_is_started_again(net: Network) -> None:
    """And what they have declared is there again."""
    net.child("router", [], router=True, to=None)
    writer, reader = net.client("writer", retry=True), net.client("reader", retry=True)
    subscriber = channel(net, reader, "a/b")
    put = publisher(net, writer, "a/b")
    net.kill("router")
    net.until(lambda: not connected(writer) and not connected(reader))
    assert not matches(put)
    net.child("router", [], router=True, to=None)
    net.until(lambda: matches(put))
    put.put(b"one")
    assert read(net, subscriber, 1) == [b"one"]


# Users and access control


@behaviour
def test_a_client_with_a_wrong_password_fails_to_open(net: Network) -> None:
    """With ZError; the right one lets it in."""
    net.router(users=USERS)
    with pytest.raises(zenoh.ZError):
        net.client("writer", user="writer", secret=WRONG)
    assert connected(net.client("writer", user="writer"))


@behaviour
def test_an_unknown_user_fails_to_open(net: Network) -> None:
    """With ZError."""
    net.router(users=USERS)
    with pytest.raises(zenoh.ZError):
        net.client("stranger", user="stranger")


@behaviour
def test_a_client_without_a_user_fails_to_open_where_users_are_asked_for(net: Network) -> None:
    """With ZError."""
    net.router(users=USERS)
    with pytest.raises(zenoh.ZError):
        net.client("nobody")


@behaviour
def test_a_router_that_has_a_user_and_knows_none_lets_in_nobody(net: Network) -> None:
    """Nor one without a user."""
    net.router(user="router")
    with pytest.raises(zenoh.ZError):
        net.client("nobody")
    with pytest.raises(zenoh.ZError):
        net.client("writer", user="writer")


def guarded(net: Network, writer: list[Right], reader: list[Right]) -> tuple[Any, Any]:
    """A writer and a reader with these rights, and those for the key `free`."""
    access = granted({"writer": [*writer, *rights(WRITES, "free")], "reader": [*reader, *rights(READS, "free")]})
    net.router(users=USERS, access=access)
    return net.client("writer", user="writer"), net.client("reader", user="reader")


def expect_lost(net: Network, writer: Any, reader: Any, *, matching: bool, read_as: str = "a/b") -> None:
    """A message of `a/b` does not come, though a later one of the key `free` does; matching: whether its publisher matches."""
    subscriber, free = channel(net, reader, read_as), channel(net, reader, "free")
    put = publisher(net, writer, "a/b") if matching else writer.declare_publisher("a/b", congestion_control=BLOCK)
    end = publisher(net, writer, "free")
    assert matches(put) == matching
    put.put(b"lost")
    end.put(END)
    assert read(net, free, 1) == [END]
    assert subscriber.try_recv() is None


@behaviour
def test_what_is_granted_passes(net: Network) -> None:
    """A put, with the rights of both."""
    writer, reader = guarded(net, rights(WRITES, "a/b"), rights(READS, "a/b"))
    subscriber = channel(net, reader, "a/b")
    publisher(net, writer, "a/b").put(b"one")
    assert read(net, subscriber, 1) == [b"one"]


@behaviour
def test_a_denied_put_is_lost_without_an_error(net: Network) -> None:
    """Though its publisher matches."""
    writer, reader = guarded(net, [("egress", "declare_subscriber", "a/b")], rights(READS, "a/b"))
    expect_lost(net, writer, reader, matching=True)


@behaviour
def test_a_denied_subscription_gets_nothing(net: Network) -> None:
    """There is no error, and the publisher does not match."""
    writer, reader = guarded(net, rights(WRITES, "a/b"), [("egress", "put", "a/b")])
    expect_lost(net, writer, reader, matching=False)


@behaviour
def test_a_reader_gets_nothing_that_may_not_go_out_to_it(net: Network) -> None:
    """Though it may subscribe."""
    writer, reader = guarded(net, rights(WRITES, "a/b"), [("ingress", "declare_subscriber", "a/b")])
    expect_lost(net, writer, reader, matching=True)


@behaviour
def test_a_writer_that_may_not_learn_of_readers_never_matches(net: Network) -> None:
    """And what it puts does not even leave it."""
    writer, reader = guarded(net, [("ingress", "put", "a/b")], rights(READS, "a/b"))
    expect_lost(net, writer, reader, matching=False)


@behaviour
def test_the_subscription_of_a_router_itself_must_be_allowed_out_to_a_writer(net: Network) -> None:
    """Otherwise its publisher does not match the router's own subscriber."""
    may = [("ingress", "put", "up"), ("ingress", "put", "down")]
    access = granted({"writer": [*may, ("egress", "declare_subscriber", "up")]})
    router = net.router(users=USERS, access=access)
    up, down = channel(net, router, "up"), channel(net, router, "down")
    writer = net.client("writer", user="writer")
    put = writer.declare_publisher("down", congestion_control=BLOCK)
    end = publisher(net, writer, "up")
    assert not matches(put)
    put.put(b"lost")
    end.put(END)
    assert read(net, up, 1) == [END]
    assert down.try_recv() is None


@behaviour
def test_a_router_reads_and_writes_without_rights(net: Network) -> None:
    """Access control is for connections; clients need theirs."""
    access = granted({"reader": [("egress", "put", "down")], "writer": rights(READS, "down")})
    router = net.router(users=USERS, access=access)
    subscriber = channel(net, net.client("writer", user="writer"), "down")
    own = channel(net, router, "down")
    publisher(net, router, "down").put(b"one")
    net.until(lambda: arrives(router.declare_publisher("down", congestion_control=BLOCK), [subscriber]))
    assert read(net, own, 1) == [b"one"]


@behaviour
def test_a_wide_subscription_is_denied_where_only_a_key_in_it_is_granted(net: Network) -> None:
    """A rule covers only what is included in it."""
    writer, reader = guarded(net, rights(WRITES, "a/b"), rights(READS, "a/b"))
    expect_lost(net, writer, reader, matching=False, read_as="a/*")


@behaviour
def test_a_denied_subscription_gets_what_its_session_reads_by_another_one(net: Network) -> None:
    """A session gives a message to all its subscribers of the key."""
    writer, reader = guarded(net, rights(WRITES, "a/b"), rights(READS, "a/b"))
    wide, exact = channel(net, reader, "a/*"), channel(net, reader, "a/b")
    publisher(net, writer, "a/b").put(b"one")
    assert read(net, exact, 1) == read(net, wide, 1) == [b"one"]


@behaviour
def test_a_rule_with_a_wildcard_covers_the_keys_in_it(net: Network) -> None:
    """And narrower wildcards."""
    writer, reader = guarded(net, rights(WRITES, "a/**"), rights(READS, "a/**"))
    subscriber = channel(net, reader, "a/*/c")
    publisher(net, writer, "a/b/c").put(b"one")
    assert read(net, subscriber, 1) == [b"one"]


def watching(net: Network, shows: list[Right], sees: list[Right]) -> tuple[Any, list[Any], list[Any]]:
    """Who shows tokens, and what another one sees of `alive/a` and `alive/b`; both with these rights."""
    net.router(users=USERS, access=granted({"writer": shows, "reader": sees}))
    reader = net.client("reader", user="reader")
    denied, granted_one = watched(reader, "alive/a"), watched(reader, "alive/b")
    return net.client("writer", user="writer"), denied, granted_one


@behaviour
def test_a_denied_token_is_not_seen(net: Network) -> None:
    """One that is granted is."""
    shower, denied, seen = watching(net, rights(TOKEN, "alive/b"), rights(WATCHES, "alive/a", "alive/b"))
    net.kept += [shower.liveliness().declare_token(key) for key in ("alive/a", "alive/b")]
    net.until(lambda: seen)
    assert denied == []


@behaviour
def test_the_end_of_a_denied_token_is_not_seen(net: Network) -> None:
    """As its beginning is not."""
    shower, denied, seen = watching(net, rights(TOKEN, "alive/b"), rights(WATCHES, "alive/a", "alive/b"))
    tokens = [shower.liveliness().declare_token(key) for key in ("alive/a", "alive/b")]
    net.until(lambda: seen)
    for token in tokens:
        token.undeclare()
    net.until(lambda: seen == [("alive/b", True), ("alive/b", False)])
    assert denied == []


@behaviour
def test_a_denied_watcher_sees_nothing(net: Network) -> None:
    """There is no error."""
    shower, denied, seen = watching(net, rights(TOKEN, "alive/a", "alive/b"), rights(WATCHES, "alive/b"))
    net.kept += [shower.liveliness().declare_token(key) for key in ("alive/a", "alive/b")]
    net.until(lambda: seen)
    assert denied == []


@behaviour
def test_a_denied_question_for_tokens_finds_nothing(net: Network) -> None:
    """It ends at once."""
    grants = {"writer": rights(TOKEN, "alive/a", "alive/b"), "reader": rights(CHECKS, "alive/b")}
    net.router(users=USERS, access=granted(grants))
    reader = net.client("reader", user="reader")
    shower = net.client("writer", user="writer")
    net.kept += [shower.liveliness().declare_token(key) for key in ("alive/a", "alive/b")]
    net.until(lambda: present(reader, "alive/b") == ["alive/b"])
    with at_once(net):
        assert present(reader, "alive/a", timeout=1000.0) == []


LIMITS = [{"id": "small", "flows": ["ingress"], "messages": ["put"], "key_exprs": ["a/**"], "size_limit": 10}]


@behaviour
def test_a_message_that_is_too_large_for_the_filter_is_dropped(net: Network) -> None:
    """Those of other keys, and those that are just small enough, pass."""
    net.router(limits=LIMITS)
    writer, reader = net.client("writer"), net.client("reader")
    limited, free = channel(net, reader, "a/b"), channel(net, reader, "c")
    put, other = publisher(net, writer, "a/b"), publisher(net, writer, "c")
    put.put(bytes(11))
    put.put(bytes(10))
    other.put(bytes(11))
    assert read(net, free, 1) == [bytes(11)]
    assert read(net, limited, 1) == [bytes(10)]


# Questions


def answering(net: Network, session: Any, key: str, *payloads: bytes) -> None:
    """Answer every question at a key with these payloads, each with the question's own before it."""

    def answer(query: Any) -> None:
        for payload in payloads:
            query.reply(key, (b"" if query.payload is None else query.payload.to_bytes()) + payload)
        query.drop()

    net.kept.append(session.declare_queryable(key, answer))


def answered(net: Network, session: Any, key: str, payload: bytes = b"?") -> list[bytes]:
    """The answers to a question, asked again until there are some: a router learns of a queryable at some time."""
    got: list[bytes] = net.until(lambda: answers(session, key, payload))
    return got


@behaviour
def test_a_question_is_answered(net: Network) -> None:
    """The one who answers gets its payload."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"!")
    assert answered(net, asker, "a/b") == [b"?!"]


@behaviour
def test_a_question_without_a_payload_is_answered(net: Network) -> None:
    """It has none."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"!")
    assert net.until(lambda: [reply.ok.payload.to_bytes() for reply in asker.get("a/b", timeout=60.0)]) == [b"!"]


@behaviour
def test_a_question_gets_the_answers_of_two_servers(net: Network) -> None:
    """If they are of different keys."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"1")
    answering(net, net.client("other"), "a/c", b"2")
    net.until(lambda: sorted(answers(asker, "a/*")) == [b"?1", b"?2"])


@behaviour
def test_a_question_gets_one_answer_of_a_key(net: Network) -> None:
    """The last one: Zenoh takes it for newer than the others."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"1", b"2", b"3")
    assert answered(net, asker, "a/b") == [b"?3"]


@behaviour
def test_a_querier_can_ask_for_all_answers_of_a_key(net: Network) -> None:
    """Without that, it gets the last one."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"1", b"2")
    answered(net, asker, "a/b")
    none = zenoh.ConsolidationMode.NONE
    for how, expected in (({}, [b"?2"]), ({"consolidation": none}, [b"?1", b"?2"])):
        querier = asker.declare_querier("a/b", timeout=60.0, **how)
        replies, over = list[Any](), net.event()
        querier.get(net.zenoh.handlers.Callback(replies.append, over.set), payload=zenoh.ZBytes(b"?"))
        net.until(over.is_set)
        assert [reply.ok.payload.to_bytes() for reply in replies] == expected


@behaviour
def test_a_question_can_be_answered_with_an_error(net: Network) -> None:
    """The error says why; it is not an answer of the key."""
    asker, server = pair(net)

    def refuse(query: Any) -> None:
        query.reply_err(b"not now")
        query.drop()

    net.kept.append(server.declare_queryable("a/b", refuse))
    [reply] = net.until(lambda: [*asker.get("a/b", timeout=60.0)])
    assert reply.ok is None
    assert reply.err.payload.to_bytes() == b"not now"
    assert reply.replier_id.eid != ROUTING


@behaviour
def test_a_question_can_be_answered_with_a_deletion(net: Network) -> None:
    """It has a key, and what comes with it, but no payload."""
    asker, server = pair(net)

    def delete(query: Any) -> None:
        query.reply_del("a/b", attachment=b"why")
        query.drop()

    net.kept.append(server.declare_queryable("a/b", delete))
    [reply] = net.until(lambda: [*asker.get("a/b", timeout=60.0)])
    assert (reply.ok.kind, str(reply.ok.key_expr)) == (zenoh.SampleKind.DELETE, "a/b")
    assert (reply.ok.payload.to_bytes(), reply.ok.attachment.to_bytes()) == (b"", b"why")


@behaviour
def test_a_session_answers_its_own_questions(net: Network) -> None:
    """Once, though its router asks it as well."""
    net.router()
    session = net.client("client")
    answering(net, session, "a/b", b"!")
    assert answered(net, session, "a/b") == [b"?!"]


@behaviour
def test_a_queryable_that_is_undeclared_is_asked_nothing_more(net: Network) -> None:
    """The question ends at once."""
    asker, server = pair(net)
    asked: list[str] = []

    def answer(query: Any) -> None:
        asked.append(str(query.key_expr))
        query.reply("a/b", b"!")
        query.drop()

    queryable = server.declare_queryable("a/b", answer)
    answered(net, asker, "a/b")
    queryable.undeclare()
    count = len(asked)
    with at_once(net):
        assert answers(asker, "a/b", timeout=1000.0) == []
    assert len(asked) == count


@behaviour
def test_an_answer_says_its_key(net: Network) -> None:
    """Which is that of the answer, not of the question."""
    asker, server = pair(net)
    answering(net, server, "a/b", b"1")
    net.until(lambda: [str(reply.ok.key_expr) for reply in asker.get("a/*", payload=b"?", timeout=60.0)] == ["a/b"])


@behaviour
def test_a_question_that_nobody_answers_ends_at_once(net: Network) -> None:
    """Without answers, long before its limit."""
    net.router()
    asker = net.client("asker")
    with at_once(net):
        assert answers(asker, "a/b", timeout=1000.0) == []


@behaviour
def test_a_question_that_is_dropped_ends(net: Network) -> None:
    """Without answers, long before its limit."""
    asker, server = pair(net)
    asked: list[str] = []

    def drop(query: Any) -> None:
        asked.append(str(query.key_expr))
        query.drop()

    net.kept.append(server.declare_queryable("a/b", drop))
    with at_once(net):
        net.until(lambda: (answers(asker, "a/b", timeout=1000.0), asked)[1])
    assert set(asked) == {"a/b"}


@behaviour
def test_a_question_can_be_answered_later(net: Network) -> None:
    """On another thread."""
    asker, server = pair(net)
    asked: list[Any] = []
    net.kept.append(server.declare_queryable("a/b", asked.append))
    got: list[bytes] = []
    thread = net.thread(lambda: got.extend(answered(net, asker, "a/b")))
    query = net.until(lambda: asked and asked.pop())
    query.reply("a/b", b"late")
    query.drop()
    del query
    net.until(lambda: got)
    thread.join(60.0)
    assert got == [b"late"]


def start_silent_server(net: Network, asker: Any) -> None:
    """Start a process that never answers a question at `a/b`; its asker knows of it."""
    net.child("server", [("silent", "a/b"), ("answers", "marker")])
    answered(net, asker, "marker")


def ask_in_vain(net: Network, asker: Any) -> tuple[Any, list[list[bytes]]]:
    """A thread that has asked, and a list that gets the answers once there are no more."""
    asking, got = net.event(), list[list[bytes]]()

    def ask() -> None:
        replies = asker.get("a/b", payload=b"?", timeout=1000.0)
        asking.set()
        got.append([*replies])

    thread = net.thread(ask)
    asking.wait(60.0)
    return thread, got


@behaviour
def test_a_question_ends_when_its_time_is_over(net: Network) -> None:
    """Though somebody still has it. There is no answer but an error; the router may report one, too."""
    net.router()
    asker = net.client("asker")
    start_silent_server(net, asker)
    began = net.now()
    replies = [*asker.get("a/b", timeout=0.5)]
    assert net.now() - began >= 0.4
    assert {reply.ok for reply in replies} == {None}
    assert {reply.err.payload.to_bytes() for reply in replies} == {b"Timeout"}
    assert {reply.replier_id is None or reply.replier_id.eid == ROUTING for reply in replies} == {True}


@behaviour
def test_a_question_ends_when_its_server_is_killed(net: Network) -> None:
    """Long before its limit."""
    net.router()
    asker = net.client("asker")
    start_silent_server(net, asker)
    thread, got = ask_in_vain(net, asker)
    net.pause(0.1)
    assert not got
    net.kill("server")
    net.until(lambda: got == [[]])
    thread.join(60.0)


@behaviour
def test_a_question_ends_when_its_asker_loses_the_router(net: Network) -> None:
    """Long before its limit."""
    net.router()
    asker = net.client("asker", cable=True)
    start_silent_server(net, asker)
    thread, got = ask_in_vain(net, asker)
    net.cut("asker")
    net.until(lambda: got == [[]])
    thread.join(60.0)


@behaviour
def test_a_question_ends_when_its_session_is_closed(net: Network) -> None:
    """Without an answer, long before its limit."""
    net.router()
    asker = net.client("asker")
    start_silent_server(net, asker)
    replies, over = list[Any](), net.event()
    asker.get("a/b", net.zenoh.handlers.Callback(replies.append, over.set), payload=b"?", timeout=1000.0)
    asker.close()
    net.until(over.is_set)
    assert replies == []


@behaviour
def test_a_question_without_a_router_finds_nobody(net: Network) -> None:
    """It ends at once."""
    net.router()
    asker = net.client("asker", cable=True)
    answering(net, net.client("server"), "a/b", b"!")
    answered(net, asker, "a/b")
    net.cut("asker")
    net.until(lambda: not connected(asker))
    with at_once(net):
        assert answers(asker, "a/b", timeout=1000.0) == []


@behaviour
def test_a_denied_question_is_not_answered(net: Network) -> None:
    """It ends at once."""
    grants = {"writer": rights(ASKS, "free"), "reader": rights(ANSWERS, "free", "a/b")}
    net.router(users=USERS, access=granted(grants))
    asker, server = net.client("writer", user="writer"), net.client("reader", user="reader")
    answering(net, server, "a/b", b"!")
    answering(net, server, "free", b"!")
    answered(net, asker, "free")
    with at_once(net):
        assert answers(asker, "a/b", timeout=1000.0) == []


@behaviour
def test_a_server_that_may_not_answer_is_not_asked(net: Network) -> None:
    """The question ends at once."""
    grants = {"writer": rights(ASKS, "free", "a/b"), "reader": rights(ANSWERS, "free")}
    net.router(users=USERS, access=granted(grants))
    asker, server = net.client("writer", user="writer"), net.client("reader", user="reader")
    asked: list[Any] = []
    net.kept.append(server.declare_queryable("a/b", asked.append))
    answering(net, server, "free", b"!")
    answered(net, asker, "free")
    assert answers(asker, "a/b", timeout=1000.0) == []
    assert asked == []


# Two linked routers


def linked(net: Network) -> tuple[Any, Any]:
    """A client at each of two linked routers."""
    net.router()
    net.router("relay", to="router")
    near, far = net.client("near"), net.client("far", "relay")
    pass_something(net, near, far)
    pass_something(net, far, near)
    return near, far


def pass_something(net: Network, writer: Any, reader: Any) -> None:
    """Wait until messages pass: for a moment, two routers that have just been linked may lose them, though publishers match."""
    subscriber = channel(net, reader, "something")
    put = publisher(net, writer, "something")
    net.until(lambda: arrives(put, [subscriber]))
    subscriber.undeclare()


@behaviour
def test_linked_routers_pass_messages_both_ways(net: Network) -> None:
    """In order, each once."""
    near, far = linked(net)
    for writer, reader, key in ((near, far, "there"), (far, near, "back")):
        subscriber = channel(net, reader, key)
        put = publisher(net, writer, key)
        for number in range(100):
            put.put(bytes([number]))
        assert read(net, subscriber, 100) == [bytes([number]) for number in range(100)]
        assert subscriber.try_recv() is None


@behaviour
def test_linked_routers_pass_the_end_of_a_subscription(net: Network) -> None:
    """The publisher at the other one matches no longer."""
    near, far = linked(net)
    subscriber = channel(net, far, "a/b")
    put = publisher(net, near, "a/b")
    subscriber.undeclare()
    net.until(lambda: not matches(put))


@behaviour
def test_linked_routers_pass_tokens_both_ways(net: Network) -> None:
    """Their coming and going."""
    near, far = linked(net)
    for shower, watcher, key in ((near, far, "alive/near"), (far, near, "alive/far")):
        seen = watched(watcher, key)
        token = shower.liveliness().declare_token(key)
        wait_for_length(net, seen, 1)
        token.undeclare()
        wait_for_length(net, seen, 2)
        assert seen == [(key, True), (key, False)]


@behaviour
def test_a_later_watcher_at_one_router_finds_a_token_at_the_other(net: Network) -> None:
    """By history."""
    near, far = linked(net)
    seen = watched(near, "alive/a")
    net.kept.append(far.liveliness().declare_token("alive/a"))
    net.until(lambda: seen)
    later = watched(net.client("later"), "alive/a")
    net.until(lambda: later == [("alive/a", True)])


@behaviour
def test_a_question_at_one_router_finds_a_token_at_the_other(net: Network) -> None:
    """Both ways, though nobody watches it."""
    near, far = linked(net)
    for shower, asker, key in ((near, far, "alive/near"), (far, near, "alive/far")):
        token = shower.liveliness().declare_token(key)
        wait_for_presence(net, asker, key, 1)
        token.undeclare()
        wait_for_presence(net, asker, key, 0)


@behaviour
def test_linked_routers_pass_questions(net: Network) -> None:
    """And their answers, both ways."""
    near, far = linked(net)
    for asker, server, key in ((near, far, "there"), (far, near, "back")):
        answering(net, server, key, b"!")
        assert answered(net, asker, key) == [b"?!"]


@behaviour
def test_a_token_goes_when_the_router_of_its_process_is_killed(net: Network) -> None:
    """As seen at the other router."""
    net.router()
    net.child("relay", [("token", "alive/relay")], router=True)
    seen = watched(net.client("watcher"), "alive/*")
    net.kept.append(net.client("shower", "relay").liveliness().declare_token("alive/a"))
    net.until(lambda: sorted(seen) == [("alive/a", True), ("alive/relay", True)])
    net.kill("relay")
    net.until(lambda: sorted(seen[2:]) == [("alive/a", False), ("alive/relay", False)])


@behaviour
def test_a_router_links_again_with_one_that_is_started_again(net: Network) -> None:
    """Messages pass again; but a key that is declared while they link may stay unknown to the other one for ever."""
    net.child("router", [], router=True, to=None)
    relay = net.router("relay", to="router")
    net.until(lambda: connected(relay))
    reader = net.client("reader", "relay")
    pass_something(net, net.client("writer"), reader)
    net.kill("router")
    net.until(lambda: not connected(relay))
    net.child("router", [], router=True, to=None)
    writer, keys = net.client("next writer"), (f"a/{number}" for number in itertools.count())

    def passes() -> bool:
        key = next(keys)
        subscriber, put = channel(net, reader, key), writer.declare_publisher(key, congestion_control=BLOCK)
        for _ in range(50):
            if arrives(put, [subscriber]):
                return True
            net.pause(0.02)
        return False

    net.until(passes)


@behaviour
def test_what_is_denied_on_a_link_does_not_pass(net: Network) -> None:
    """What is granted does, both ways."""
    to_relay, from_relay = rights(READS, "there"), rights(WRITES, "back")
    near_rights = [*rights(WRITES, "there", "denied"), *rights(READS, "back", "denied back")]
    access = granted({"relay": [*to_relay, *from_relay], "near": near_rights})
    net.router(users=("relay", "near"), access=access)
    net.router("relay", to="router", user="relay", users=("far",))
    near, far = net.client("near", user="near"), net.client("far", "relay", user="far")
    there, denied, back, denied_back = (
        channel(net, reader, key)
        for reader, key in ((far, "there"), (far, "denied"), (near, "back"), (near, "denied back"))
    )
    put, put_back = publisher(net, near, "there"), publisher(net, far, "back")
    net.until(lambda: arrives(put, [there]) and arrives(put_back, [back]))
    near.declare_publisher("denied", congestion_control=BLOCK).put(b"denied")
    put.put(END)
    read_until(net, there)
    far.declare_publisher("denied back", congestion_control=BLOCK).put(b"denied")
    put_back.put(END)
    read_until(net, back)
    assert denied.try_recv() is denied_back.try_recv() is None


@behaviour
def test_a_router_can_grant_rights_to_another_by_its_id(net: Network) -> None:
    """Which has no user name there."""
    net.router(zid="abc1")
    access = granted({"router": rights(WRITES, "there"), "far": rights(READS, "there", "denied")}, {"router": "abc1"})
    net.router("relay", to="router", users=("far",), access=access)
    near, far = net.client("near"), net.client("far", "relay", user="far")
    there, denied = channel(net, far, "there"), channel(net, far, "denied")
    put = publisher(net, near, "there")
    net.until(lambda: arrives(put, [there]))
    near.declare_publisher("denied", congestion_control=BLOCK).put(b"denied")
    put.put(END)
    read_until(net, there)
    assert denied.try_recv() is None


@behaviour
def test_a_router_waits_for_the_one_that_it_links_with(net: Network) -> None:
    """It opens without it, and links once it is there."""
    relay = net.router("relay", to="router")
    assert not connected(relay)
    net.router()
    net.until(lambda: connected(relay))


@pytest.mark.long
@behaviour
def test_a_connection_that_flaps_brings_messages_to_the_wrong_subscriber(net: Network) -> None:
    """One in many thousand, which says that it is of that subscriber's key (1.9.0 to 1.10.2): only its payload can tell.

    Where this fails, a message that names another key need not be looked for any more.
    """
    router = net.router()
    wrong: list[tuple[str, str]] = []
    over = net.event()

    def subscribe(client: Any, key: str) -> None:
        def take(sample: Any) -> None:
            named = sample.payload.to_bytes().decode()
            if named != key:
                wrong.append((named, str(sample.key_expr)))

        net.kept.append(client.declare_subscriber(key, take))

    def put(publishers: Mapping[str, Any]) -> None:
        while not over.is_set():
            for key, declared in publishers.items():
                declared.put(key.encode())
            net.pause(1e-3)

    def declared(session: Any, *keys: str) -> dict[str, Any]:
        return {key: session.declare_publisher(key, congestion_control=BLOCK) for key in keys}

    names, sent = [f"client{i}" for i in range(5)], dict[str, Any]()
    threads = []
    for name in names:
        client = net.client(name, cable=True, retry=True)
        for kind in ("control", "downlink"):
            subscribe(client, f"{kind}/{name}")
            net.kept.append(router.declare_subscriber(f"{kind} back/{name}", lambda _: None))
        sent |= declared(router, f"control/{name}", f"downlink/{name}")
        threads.append(net.thread(partial(put, declared(client, f"control back/{name}", f"downlink back/{name}"))))
    threads.append(net.thread(partial(put, sent)))

    def happened() -> bool:
        for _ in range(12):
            for name in names:
                net.make_stale(name)
            net.pause(0.02)
        net.pause(0.2)
        return len(wrong) > 0

    net.until(happened, "message at the wrong subscriber", 600.0)
    over.set()
    for thread in threads:
        thread.join()
    for named, shown in wrong:
        assert {named.partition("/")[0], shown.partition("/")[0]} == {"control", "downlink"}
