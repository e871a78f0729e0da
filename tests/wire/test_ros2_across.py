"""ROS 2 across a wire: nodes that behave as those of rmw_zenoh, at sides that lose messages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.wire.file import load_wire
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.plan import Side, WireLink, WirePlan
from evedrop.wire.relay import WireRelay, open_sides
from tests.conftest import LIMIT, wait_until
from tests.wire.rmw import Node, ReceivedMessage, ros_context
from tests.wire.wire_links import key_fates

LOSSY = {"loss": {"model": "gilbert-elliott", "p": 0.2, "r": 0.4}}
WHOLE = {"loss": {"model": "bernoulli", "quality": 1.0}}
HALF = {"loss": {"model": "bernoulli", "quality": 0.5}}
LINKS = (
    WireLink("scan", 0, "robot", "base", "*/scan/**", LOSSY),
    WireLink("map", 1, "robot", "base", "*/map/**", WHOLE),
    WireLink("radio", 2, "robot", "base", "**", WHOLE),
    WireLink("requests", 3, "base", "robot", "*/lossy/**", HALF),
    WireLink("commands", 4, "base", "robot", "**", WHOLE),
)
PLAN = WirePlan(7, {name: Side(name, ("tcp/127.0.0.1:0",)) for name in ("robot", "base")}, LINKS)


@dataclass
class Field:
    """A wire with a session at each of its two sides."""

    relay: WireRelay
    folder: Path
    robot: zenoh.Session
    base: zenoh.Session

    def rows(self, key: str, kind: str) -> list[dict[str, Any]]:
        """What the journal has of a topic or service."""
        rows = [row for table in journal_tables(self.folder) for row in table.to_pylist()]
        return [
            row for row in rows if f"/{key}/" in f"/{row['key']}" and "@adv" not in row["key"] and row["kind"] == kind
        ]


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    """A wire for all tests here; each uses topics of its own."""
    folder = tmp_path_factory.mktemp("wire")
    with (
        WireJournal(folder, PLAN) as journal,
        open_sides(PLAN) as sides,
        WireRelay(PLAN, journal, sides) as relay,
        ros_context(relay.endpoints["robot"][0]) as robot,
        ros_context(relay.endpoints["base"][0]) as base,
    ):
        yield Field(relay, folder, robot, base)


def test_a_listener_lacks_what_the_seed_says(field: Field) -> None:
    """The journal names the publisher's gid and number of each message, and the listener got those that it calls delivered."""
    talker, listener = Node(field.robot, "talker"), Node(field.base, "listener")
    heard = listener.subscription("/scan")
    publish = talker.publisher("/scan")
    wait_until(lambda: talker.sees("MS", "/scan") and listener.sees("MP", "/scan"), "nodes see each other")
    publish("first")
    wait_until(lambda: field.rows("scan", "put"), "the wire hears the talker")
    sent = [publish(f"scan {n}") for n in range(200)]
    rows = wait_until(lambda: len(r := field.rows("scan", "put")) == 201 and r, "the journal has all messages")
    key = rows[0]["key"]
    fates = key_fates(LINKS[0], key, "put", PLAN.seed)
    assert [row["sequence"] for row in rows] == [1, *sent]
    passed = [row["sequence"] for row in rows if fates.next()[0] == 0]
    assert 100 < len(passed) < 180
    wait_until(lambda: len(heard) >= len(passed), "the listener gets them")
    assert [message.sequence for message in heard] == passed
    assert {row["source"] for row in rows} == {message.gid for message in heard}
    assert [row["sequence"] for row in rows if row["fate"] == "delivered"] == passed
    entities = [json.loads(line) for line in (field.folder / "ros2.jsonl").read_text().splitlines()]
    (publisher,) = (entity for entity in entities if entity["gid"] == heard[0].gid)
    assert (publisher["side"], publisher["node"], publisher["topic"]) == ("robot", "/talker", "/scan")
    assert heard[-1].text == f"scan {passed[-1] - 2}"


def test_a_service_answers_as_soon_as_it_is_seen(field: Field) -> None:
    """A client finds the service of the other side as a complete queryable from the moment that the graph shows it."""
    server, caller = Node(field.robot, "server"), Node(field.base, "caller")
    for n in range(30):
        name = f"/add_{n}"
        send, responses = caller.client(name)
        server.service(name)
        while not caller.sees("SS", name):  # at once: a pause would hide that the service cannot be asked yet
            assert caller.changed.wait(LIMIT), "the graph shows the service"
            caller.changed.clear()
        sequence = send(n, 40)
        wait_until(responses.__len__, "the response")
        assert [(response.sequence, response.text) for response in responses] == [(sequence, n + 40)]


def test_a_lost_request_is_never_answered(field: Field) -> None:
    """Requests that the link loses reach no server, and those that it passes are answered; the journal names the client."""
    server, caller = Node(field.robot, "lossy_server"), Node(field.base, "lossy_caller")
    taken = server.service("/lossy")
    send, responses = caller.client("/lossy")
    wait_until(lambda: caller.sees("SS", "/lossy"), "the graph shows the service")
    for n in range(40):
        send(n, 1)
    rows = wait_until(lambda: len(r := field.rows("lossy", "query")) == 40 and r, "the journal has all requests")
    fates = key_fates(LINKS[3], rows[0]["key"], "query", PLAN.seed)
    passed = [n for n in range(1, 41) if fates.next()[0] == 0]
    wait_until(lambda: len(responses) == len(passed), "the responses")
    assert (
        sorted(response.sequence for response in taken) == sorted(response.sequence for response in responses) == passed
    )
    assert {row["source"] for row in rows} == {responses[0].gid}
    assert {row["source"] for row in field.rows("lossy", "reply")} == {responses[0].gid}


def test_nodes_are_seen_from_the_other_side_while_they_live(field: Field) -> None:
    """The graph has the nodes of both sides, a late node learns it, and it forgets nodes that end."""
    watcher = Node(field.base, "watcher")
    with ros_context(field.relay.endpoints["robot"][0]) as context:
        node = Node(context, "short_lived", "/robot")
        node.publisher("/short_lived")
        wait_until(lambda: watcher.sees("MP", "/short_lived") == 1, "the publisher appears")
        late = Node(field.base, "late")
        wait_until(lambda: late.sees("MP", "/short_lived") == 1, "a late node learns of it")
        wait_until(lambda: any("/NN/%/%/late" in token for token in node.graph), "the robot sees the base")
    wait_until(lambda: watcher.sees("MP", "/short_lived") == late.sees("MP", "/short_lived") == 0, "it is forgotten")


def test_a_late_joiner_gets_the_history_and_what_follows(field: Field) -> None:
    """The messages that a transient-local publisher keeps arrive once and in order, and so do those that follow."""
    mapper, viewer = Node(field.robot, "mapper"), Node(field.base, "viewer")
    publish = mapper.publisher("/map", kept=3)
    for n in range(5):
        publish(f"map {n}")
    wait_until(lambda: viewer.sees("MP", "/map") and len(field.rows("map", "put")) == 5, "all this has crossed")
    heard = viewer.subscription("/map", kept=3)
    wait_until(lambda: len(heard) >= 3 and len(field.rows("map", "reply")) == 6, "the history, asked for in two ways")
    publish("map 5")
    wait_until(lambda: len(heard) >= 4, "a new message")
    assert [message.text for message in heard] == ["map 2", "map 3", "map 4", "map 5"]
    assert [message.sequence for message in heard] == [3, 4, 5, 6]


def has(heard: list[ReceivedMessage], text: str) -> bool:
    """Whether a message was heard."""
    return any(message.text == text for message in heard)


def test_what_a_link_loses_of_a_reliable_topic_that_is_kept_is_fetched_again(tmp_path: Path) -> None:
    """The subscriber notices the gap with the next message and asks for it; a message that was not lost may come twice."""
    # Replies have the link's losses too: those to the question for the history, 10 at most, and for the gap are before the 0.
    lost = 12
    (tmp_path / "losses.csv").write_text("1\n" * lost + "0\n" + "1\n" * 60)
    (tmp_path / "wire.toml").write_text("""
        side.robot.listen = "tcp/127.0.0.1:0"
        side.base.listen = "tcp/127.0.0.1:0"
        [[link]]
        from = "robot"
        to = "base"
        loss = { model = "trace", file = "losses.csv" }
        [[link]]
        from = "base"
        to = "robot"
    """)
    plan = load_wire(tmp_path / "wire.toml")
    with (
        WireJournal(tmp_path, plan) as journal,
        open_sides(plan) as sides,
        WireRelay(plan, journal, sides) as relay,
        ros_context(relay.endpoints["robot"][0]) as robot,
        ros_context(relay.endpoints["base"][0]) as base,
    ):
        mapper, viewer = Node(robot, "mapper"), Node(base, "viewer")
        heard = viewer.subscription("/map", kept=10)
        publish = mapper.publisher("/map", kept=10)
        wait_until(lambda: mapper.sees("MS", "/map") and viewer.sees("MP", "/map"), "nodes see each other")
        for n in range(lost + 3):
            publish(f"map {n}")
            if n != lost:
                wait_until(partial(has, heard, f"map {n}"), "it arrives")
        wait_until(partial(has, heard, f"map {lost}"), "what was lost arrives")
        rows = [row for table in journal_tables(tmp_path) for row in table.to_pylist() if row["fate"] == "lost"]
    assert {message.text for message in heard} == {f"map {n}" for n in range(lost + 3)}
    assert [(row["kind"], row["n"]) for row in rows if "@adv" not in row["key"]] == [("put", lost)]
