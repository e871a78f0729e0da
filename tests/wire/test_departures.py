"""Programs that lose their connection to a wire are named, if many messages waited at that moment or if they come back."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from evedrop import wire
from evedrop.wire.departures import MANY, MOST, MOST_GONE, Backlog, Departures
from evedrop.wire.publications import PublicationRelay
from evedrop.wire.watchdog import Duty
from tests.clock import TestClock
from tests.conftest import LIMIT, wait_until
from tests.pages import checked
from tests.wire.wire_at_work import at_work, both_ways, program

BLOCK = zenoh.CongestionControl.BLOCK
PUT, DELETE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
SOON = {"transport": {"link": {"tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 50_000}}}}}}}
"""A program waits for 50 ms, not for 5 s, before it ends its connection."""


@pytest.fixture
def held_up() -> Event:
    """Is set when a wire has a message in hand and does not go on."""
    return Event()


@pytest.fixture
def goes_on(monkeypatch: pytest.MonkeyPatch, held_up: Event) -> Iterator[Event]:
    """Wires take no further message until this is set."""
    may_go_on = Event()
    way_to = PublicationRelay._way_to

    def held(self: PublicationRelay, *arguments: Any) -> Any:
        held_up.set()
        may_go_on.wait(LIMIT)
        return way_to(self, *arguments)

    monkeypatch.setattr(PublicationRelay, "_way_to", held)
    yield may_go_on
    may_go_on.set()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Event:
    """Is set when a wire has asked how many messages wait."""
    done = Event()
    ask = Backlog.ask

    def asks(self: Backlog, answer: Callable[[int], None]) -> None:
        ask(self, answer)
        done.set()

    monkeypatch.setattr(Backlog, "ask", asks)
    return done


@pytest.fixture(autouse=True)
def linked(monkeypatch: pytest.MonkeyPatch) -> Event:
    """Is set when a wire knows from where a program is connected."""
    done = Event()
    note = Departures._linked

    def notes(self: Departures, side: str, event: zenoh.LinkEvent) -> None:
        note(self, side, event)
        done.set()

    monkeypatch.setattr(Departures, "_linked", notes)
    return done


def send_until_disconnected(sender: zenoh.Session) -> None:
    """Publish with `BLOCK` until Zenoh ends the connection."""
    ended = Event()

    def changed(event: zenoh.TransportEvent) -> None:
        if event.kind == DELETE:
            ended.set()

    listener = sender.info.declare_transport_events_listener(changed)

    def send() -> None:
        while not ended.is_set():
            sender.put("scan", bytes(60_000), congestion_control=BLOCK)

    thread = Thread(target=send, daemon=True)
    thread.start()
    assert ended.wait(LIMIT)
    thread.join(LIMIT)
    listener.undeclare()


@pytest.mark.thorough
def test_a_program_that_zenoh_disconnects_because_the_wire_is_behind_is_named(
    tmp_path: Path, goes_on: Event, linked: Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its id, its mode, and from where it was connected, when it has come back."""
    monkeypatch.setattr("evedrop.wire.publications.WAITING", 16)
    with at_work(both_ways(), tmp_path) as at, at.program("robot", **SOON) as sender:
        assert linked.wait(LIMIT)
        send_until_disconnected(sender)
        goes_on.set()
        wait_until(lambda: at.happened, "it is named")
        who = rf"the program {sender.zid()} \(client, tcp/127\.0\.0\.1:\d+\)"
        again = rf"\d+\.\d s: {who} is connected to the side robot again, \d+\.\d s after its connection ended"
        assert re.match(again, at.happened[0]), at.happened
        assert at.told == []


def test_a_program_whose_messages_wait_when_its_connection_ends_is_named(
    tmp_path: Path, goes_on: Event, held_up: Event, asked: Event, linked: Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With their number; that the wire is held up in the meantime changes nothing."""
    monkeypatch.setattr("evedrop.wire.departures.MANY", 5)
    with at_work(both_ways(), tmp_path) as at:
        with at.program("robot") as sender:
            zid = str(sender.zid())
            assert linked.wait(LIMIT)
            for _ in range(6):
                sender.put("scan", b"x", congestion_control=BLOCK)
            assert held_up.wait(LIMIT)
        assert asked.wait(LIMIT)
        goes_on.set()
        wait_until(lambda: at.happened, "it is named")
        who = rf"the program {zid} \(client, tcp/127\.0\.0\.1:\d+\)"
        ended = rf"\d+\.\d s: the connection of {who} to the side robot ended while 6 messages from this side waited for the "
        assert re.match(ended + "wire; ", at.happened[0]), at.happened


def test_a_program_that_ends_is_not_named(tmp_path: Path) -> None:
    """Neither is one that is connected when the wire ends."""
    with at_work(both_ways(), tmp_path) as at:
        with at.program("robot") as sender:
            sender.put("scan", b"x", congestion_control=BLOCK)
            at.when_heard(1)
        staying = at.program("robot")
        with at.program("base") as reader:
            wait_until(reader.info.routers_zid, "it is connected")
    staying.close()
    assert at.happened == []


@pytest.mark.thorough
def test_a_program_that_comes_back_is_in_status_summary_and_report(tmp_path: Path) -> None:
    """As an event of the wire."""
    running = wire(side=["robot", "base"], link=[{"from": "robot", "to": "base"}], out=tmp_path / "wire")
    with running:
        again = {"endpoints": [running.endpoint("robot")], "timeout_ms": -1, "retry": {"period_init_ms": 50}}
        for _ in range(2):
            with program([], id="abcdef01", connect=again) as session:
                wait_until(session.info.routers_zid, "it is connected")
        returned = "the program abcdef01 (client"
        lines = wait_until(lambda: running.status().events, "it is in the status")
        assert [line.partition(": ")[2].startswith(returned) for line in lines] == [True]
        assert any(line.startswith("event at ") and returned in line for line in running.status().lines)
    events = [event.event for event in running.typed_summary().events]
    assert [event.startswith(returned) for event in events] == [True]
    assert any(events[0] in text for text in checked(tmp_path / "wire").texts)


class Sides:
    """A wire without Zenoh: the connections of one side, and what waits there."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.asked: list[Callable[[int], None]] = []
        self.waiting_for = 0
        self.clock = TestClock()
        backlogs = cast("Any", {"robot": [SimpleNamespace(ask=self.asked.append)] * 2})
        self.departures = Departures(backlogs, lambda _: self.waiting_for, self.lines.append, self.clock)

    def connect(self, zid: str = "a1", user: str | None = None) -> None:
        """A program connects."""
        self.connect_link(zid, user)
        self._changed(PUT, zid)

    def connect_link(self, zid: str, user: str | None = None) -> None:
        """The event that says from where it is connected."""
        link = SimpleNamespace(zid=zid, dst="tls/10.0.0.2:5", auth_identifier=user)
        self.departures._linked("robot", cast("Any", SimpleNamespace(kind=PUT, link=link)))

    def leave(self, zid: str = "a1", *waiting: int) -> None:
        """Its connection ends while so many messages wait in the backlogs."""
        self._changed(DELETE, zid)
        for number in waiting:
            self.asked.pop(0)(number)

    def _changed(self, kind: zenoh.SampleKind, zid: str) -> None:
        event = SimpleNamespace(kind=kind, transport=SimpleNamespace(zid=zid, whatami="client"))
        self.departures._changed("robot", cast("Any", event))


def test_what_waited_is_told_once() -> None:
    """At once if it was much, and else when the program comes back, with the time in between."""
    at = Sides()
    at.connect(user="arm.local")
    at.leave("a1", MANY - 1, 0)
    assert at.lines == []
    at.clock.sleep(2.5)
    at.connect(user="arm.local")
    who = "the program a1 (client, tls/10.0.0.2:5, as arm.local)"
    assert at.lines[0].startswith(
        f"{who} is connected to the side robot again, 2.5 s after its connection ended while 4,095 messages from this side "
        "waited for the wire; "
    )
    at.waiting_for = 3
    at.leave("a1", MANY // 2, MANY // 2)
    assert at.lines[1].startswith(
        f"the connection of {who} to the side robot ended while 4,096 messages from this side waited for the wire and 3 messages "
        "waited for programs at this side; "
    )
    at.connect()
    assert "0.0 s after its connection ended; " in at.lines[2]


def test_a_reader_for_which_much_waits_is_named() -> None:
    """Zenoh ends its connection if it does not read."""
    at = Sides()
    at.connect()
    at.waiting_for = MANY
    at.leave("a1", 0, 0)
    assert [line.partition(";")[0] for line in at.lines] == [
        "the connection of the program a1 (client, tls/10.0.0.2:5) to the side robot ended while 4,096 messages waited for "
        "programs at this side"
    ]


def test_few_lines_and_few_programs_are_kept() -> None:
    """However many programs come and go; and a program that went before many others is forgotten."""
    at = Sides()
    for number in range(MOST_GONE + 1):
        at.connect(f"{number}")
        at.leave(f"{number}", 0, 0)
    at.connect("0")
    assert at.lines == []
    for _ in range(2 * MOST):
        at.connect("1")
        at.leave("1", 0, 0)
    assert len(at.lines) == MOST + 1
    assert (
        at.lines[-1] == f"there were more than {MOST} programs that lost their connection; further ones are not listed"
    )


def test_where_a_program_was_is_forgotten_in_any_order_of_events() -> None:
    """Those of links and those of connections come by different threads."""
    at = Sides()
    for late in (False, True):
        if late:
            at._changed(PUT, "a1")
            at.leave("a1", 0, 0)
        at.connect_link("a1")
        if not late:
            at._changed(PUT, "a1")
        at.departures._linked("robot", cast("Any", SimpleNamespace(kind=DELETE, link=SimpleNamespace(zid="a1"))))
        if not late:
            at.leave("a1", 0, 0)
        assert at.departures._links == {}


def test_a_program_has_its_address_when_all_events_of_its_link_come_first() -> None:
    """Those of its connection come by another thread, which may be slow."""
    at = Sides()
    at.connect_link("a1")
    at.departures._linked("robot", cast("Any", SimpleNamespace(kind=DELETE, link=SimpleNamespace(zid="a1"))))
    at._changed(PUT, "a1")
    at.leave("a1", MANY, 0)
    assert "the program a1 (client, tls/10.0.0.2:5)" in at.lines[0]


def test_nobody_is_named_when_the_wire_ends() -> None:
    """It ends all connections itself."""
    at = Sides()
    at.connect()
    at.departures.close()
    at.leave()
    at.connect()
    assert (at.asked, at.lines) == ([], [])


class Channel:
    """A channel of Zenoh: `recv` gives the messages of `later`, and then the channel is closed."""

    def __init__(self, now: int, later: int = 0) -> None:
        self.now, self.later = now, later

    def try_recv(self) -> object | None:
        """The next message that waits."""
        if not self.now:
            return None
        self.now -= 1
        return object()

    def recv(self) -> object:
        """The next message to come."""
        if not self.later:
            raise zenoh.ZError("closed")
        self.later -= 1
        return object()


@pytest.mark.parametrize(("waiting", "most", "counted"), [(5, 8, 5), (8, 3, 3)])
def test_messages_that_wait_are_counted_as_they_are_taken(waiting: int, most: int, counted: int) -> None:
    """From the one in hand until the channel is empty, and no more than it has room for."""
    backlog, answers = Backlog(Channel(waiting, later=2), most), list[int]()
    duty, taken = Duty("here"), list[object]()

    def take(sample: zenoh.Sample) -> None:
        assert duty.in_hand is sample
        taken.append(sample)
        if len(taken) == 1:
            backlog.ask(answers.append)

    backlog.take_all(take, duty)
    assert (answers, len(taken), duty.in_hand) == ([counted], waiting + 2, None)


def test_an_empty_backlog_answers_at_once() -> None:
    """Also after its end, when nothing is taken any more."""
    backlog, answers = Backlog(Channel(0), 8), list[int]()
    backlog.ask(answers.append)
    assert answers == []  # its thread has not looked yet
    backlog.take_all(lambda _: None, Duty("here"))
    assert answers == [0]
    backlog.ask(answers.append)
    assert answers == [0, 0]
