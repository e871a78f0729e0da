"""Messages that arrive on a key they do not name: each kind of reader drops and counts them, and the connection is renewed."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
import zenoh

from evedrop.errors import MalformedMessage, MissingProcesses
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.access import users_file
from evedrop.live.network.connection import Question, SubscriptionClosedError
from evedrop.live.network.control_file import Control
from evedrop.live.network.operator import Answer, ask
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Reader, enclosed, head_of, named_in
from evedrop.live.protocol.commands import EndRun, LinkChange, Start
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import Progress
from evedrop.live.protocol.requests import StatusRequest
from evedrop.model.slot.link import Change
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import is_matched, small_network
from tests.proxy import Cable, cable

GOOD = Progress(7).pack()


def foreign(keys: RunKeys, key: str) -> list[bytes]:
    """Messages that do not belong on a key: of another key, of another run, and with no envelope."""
    other = key.replace(keys.run, "another-run")
    return [enclosed(keys.control("smart"), GOOD), enclosed(other, GOOD), GOOD, b"", b"\xc1", head_of(key)[:-1]]


class Stage:
    """A Zenoh router without access control in this very process, and briefs that lead to it through a cable."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        port = free_port()
        self.cable: Cable = stack.enter_context(cable(port))
        task = RecorderTask(folder / "results", False)
        self.briefs = briefs_of(small_network(), endpoints_at(self.cable.endpoint), task, ends_with_stdin=False)
        with users_file(
            {"operator": "password", **{brief.user: brief.password for brief in self.briefs.values()}}
        ) as users:
            config = {
                "mode": "router",
                "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "transport": {"auth": {"usrpwd": {"dictionary_file": str(users)}}},
            }
            self.router = stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))
        self.keys = RunKeys(self.briefs["eve"].run)

    @property
    def eve(self) -> AnyBrief:
        """Of an eavesdropper."""
        return self.briefs["eve"]

    def reads(self, key: str) -> None:
        """Wait until somebody reads a key."""
        publisher = self.router.declare_publisher(key)
        wait_until(lambda: is_matched(publisher), f"a reader of {key}")
        publisher.undeclare()

    def put(self, key: str, messages: list[bytes]) -> None:
        """Put messages on a key, whatever they name."""
        self.reads(key)
        for message in messages:
            self.router.put(key, message, congestion_control=zenoh.CongestionControl.BLOCK)


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """A router, for one test."""
    with ExitStack() as stack:
        yield Stage(tmp_path, stack)


def test_a_message_names_its_key() -> None:
    """The key is read from the front of a message; anything else has no key."""
    assert named_in(enclosed("evedrop/r/uplink", GOOD)) == "evedrop/r/uplink"
    for message in (b"", b"\xc1", GOOD, b"\xd9\xff", b"\xa5uplin"[:3]):
        assert named_in(message) is None


def test_a_subscription_drops_what_names_another_key(stage: Stage, capfd: pytest.CaptureFixture[str]) -> None:
    """Only what names its own key is read; the rest is counted, and standard error says which key was named."""
    key = stage.keys.downlink("eve")
    with Session(stage.eve) as session:
        subscription = session.subscribe(key)
        stage.put(key, [*foreign(stage.keys, key), enclosed(key, GOOD)])
        assert subscription.recv() == GOOD
        assert session.dropped.count == len(foreign(stage.keys, key))
    errors = capfd.readouterr().err
    assert f"eve: dropped a message that came on {key} and names {stage.keys.control('smart')} (number 1)" in errors


def test_a_callback_subscription_drops_what_names_another_key(stage: Stage) -> None:
    """As an subscription, whatever the key is."""
    key, heard = stage.keys.telemetry("eve"), SimpleQueue[bytes]()
    with Session(stage.briefs["recorder"]) as session:
        session.subscribe_with(key, heard.put)
        stage.put(key, [*foreign(stage.keys, key), enclosed(key, GOOD)])
        assert heard.get(timeout=LIMIT) == GOOD
        assert heard.empty()
        assert session.dropped.count == len(foreign(stage.keys, key))


def test_commands_that_name_another_process_are_dropped(stage: Stage) -> None:
    """A command on a process's own control key is obeyed only if it is meant for it."""
    key, other = stage.keys.control("eve"), stage.keys.control("mallory")
    with Session(stage.eve) as session:
        stage.put(key, [enclosed(other, EndRun().pack()), enclosed(key, Start().pack())])
        assert session.command() == Start()
        assert session.dropped.count == 1


def test_a_command_with_all_changes_of_a_link_is_read(stage: Stage) -> None:
    """An operator changes a link that has thousands of events, and the router gets them all."""
    key = stage.keys.control("eve")
    settings = {"loss": {"model": "bernoulli", "quality": 0.5}}
    change = LinkChange("eve", tuple(Change(k % 20, settings) for k in range(20_000)))
    with Session(stage.eve) as session:
        stage.put(key, [enclosed(key, change.pack())])
        assert session.command() == change


def test_a_question_that_names_another_key_is_not_answered(stage: Stage) -> None:
    """Nor handed on; one that names its key is."""
    key, asked = stage.keys.control("recorder"), SimpleQueue[Question]()
    with Session(stage.briefs["recorder"]) as session:
        session.asked(key, asked.put)
        querier = stage.router.declare_querier(key)
        wait_until(lambda: is_matched(querier), "somebody to be asked")
        for message in foreign(stage.keys, key):
            assert list(stage.router.get(key, payload=message, timeout=2.0)) == []
        assert asked.empty()
        assert session.dropped.count == len(foreign(stage.keys, key))
        asking = threading.Thread(target=lambda: list(stage.router.get(key, payload=enclosed(key, GOOD))))
        asking.start()
        question = asked.get(timeout=LIMIT)
        assert question.payload == GOOD
        question.answer(GOOD)
        asking.join(LIMIT)
        assert not asking.is_alive(), "the router cannot be closed while it is used"


def test_an_answer_that_names_another_key_is_none(stage: Stage) -> None:
    """The operator takes an answer for its own only if it names the key at which it asked."""
    key, answers = stage.keys.control("recorder"), SimpleQueue[bytes]()

    def answer(query: zenoh.Query) -> None:
        query.reply(key, answers.get())
        query.drop()

    stage.router.declare_queryable(key, answer)
    entry = Control(stage.eve.run, stage.eve.router, "operator", "password")
    for message in (*foreign(stage.keys, key), enclosed(stage.keys.control("eve"), Answer(3, "no").pack())):
        answers.put(message)
        assert ask(entry, StatusRequest(), 2.0) is None
    answers.put(enclosed(key, Answer(7, "yes").pack()))
    assert ask(entry, StatusRequest(), LIMIT) == Answer(7, "yes")


def test_a_malformed_message_of_its_own_key_is_an_error(stage: Stage) -> None:
    """Bytes that name their key but are not a message are not dropped: the error names the key, and with it the sender."""
    key = stage.keys.downlink("eve")
    with Session(stage.eve) as session:
        subscription = session.subscribe(key)
        stage.put(key, [enclosed(key, b"\xc1")])
        with pytest.raises(MalformedMessage, match=f"malformed message on {key}"):
            Reader(key, subscription.recv())
        assert session.dropped.count == 0


@pytest.mark.thorough
def test_a_connection_that_comes_and_goes_does_not_hold_up_a_process_for_ever(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time in which it is there counts, also if it is never there for the whole patience."""
    looks = count()

    def linked(_: Session) -> bool:
        if threading.current_thread() is not threading.main_thread():
            return True
        look = next(looks)
        assert look < 3000, "it waits on"
        return look % 2 == 0

    with Session(replace(stage.eve, patience=1)) as session:
        session.publisher(stage.keys.telemetry("eve"))
        monkeypatch.setattr(Session, "linked", linked)
        with pytest.raises(MissingProcesses, match="nobody reads"):
            session.ready()


def test_a_lost_connection_is_replaced(stage: Stage) -> None:
    """By another session with another id, on which subscriptions, publisher, watch and token are declared again."""
    keys, watched, tokens = stage.keys, SimpleQueue[bool](), SimpleQueue[bool]()
    heard, handed_on = SimpleQueue[bytes](), SimpleQueue[bytes]()
    stage.router.declare_subscriber(keys.progress("eve"), lambda sample: heard.put(sample.payload.to_bytes()))
    token = stage.router.liveliness().declare_token(keys.alive("router"))
    stage.router.liveliness().declare_subscriber(
        keys.alive("eve"), lambda sample: tokens.put(sample.kind == zenoh.SampleKind.PUT)
    )
    with Session(stage.eve) as session:
        subscription = session.subscribe(keys.downlink("eve"))
        session.subscribe_with(keys.telemetry("eve"), handed_on.put)
        put = session.publisher(keys.progress("eve"))
        session.watch("router", watched.put)
        session.ready()
        assert watched.get(timeout=LIMIT)
        assert tokens.get(timeout=LIMIT)
        stage.put(keys.downlink("eve"), [enclosed(keys.downlink("eve"), Progress(1).pack())])
        stage.put(keys.telemetry("eve"), [enclosed(keys.telemetry("eve"), Progress(0).pack())])
        assert handed_on.get(timeout=LIMIT) == Progress(0).pack()  # so the one before it has arrived too
        ids = {str(session.connection.session.zid())}
        for _ in range(3):
            stage.cable.flap()
            assert [tokens.get(timeout=LIMIT) for _ in range(2)] == [False, True]
            assert [watched.get(timeout=LIMIT) for _ in range(2)] == [False, True]
            # One flap may cost two sessions; the events of the second then come early at the next flap.
            wait_until(lambda: str(session.connection.session.zid()) not in ids, "another session")
            ids.add(str(session.connection.session.zid()))
        stage.put(keys.downlink("eve"), [enclosed(keys.downlink("eve"), Progress(2).pack())])
        stage.put(keys.telemetry("eve"), [enclosed(keys.telemetry("eve"), Progress(3).pack())])
        assert subscription.recv() == Progress(2).pack()  # what was not read on the first session is lost with it
        assert handed_on.get(timeout=LIMIT) == Progress(3).pack()
        wait_until(lambda: session.reaches(keys.progress("eve")), "the reader of its progress")
        put(GOOD)
        assert heard.get(timeout=LIMIT) == enclosed(keys.progress("eve"), GOOD)
    assert tokens.get(timeout=LIMIT) is False
    token.undeclare()


@pytest.mark.thorough
def test_a_connection_that_takes_one_key_for_another_is_replaced(stage: Stage) -> None:
    """A message of another key makes a process open another session: nothing of the old one is trusted any more."""
    key, other = stage.keys.downlink("eve"), stage.keys.downlink("mallory")
    with Session(stage.eve) as session:
        subscription = session.subscribe(key)

        def renewed() -> bool:
            stage.router.put(key, enclosed(other, GOOD))
            return session.connection.openings > 1

        reads = threading.Thread(target=lambda: list(subscription))
        reads.start()
        wait_until(renewed, "another session")
    reads.join(LIMIT)
    assert not reads.is_alive()


def test_a_subscription_that_is_closed_says_so(stage: Stage) -> None:
    """Nobody waits forever for what cannot arrive any more."""
    with Session(stage.eve) as session:
        subscription = session.subscribe(stage.keys.downlink("eve"))
        caught: list[Any] = []

        def read() -> None:
            try:
                subscription.recv()
            except SubscriptionClosedError as error:
                caught.append(error)

        reads = threading.Thread(target=read)
        reads.start()
    reads.join(LIMIT)
    assert [str(error) for error in caught] == [stage.keys.downlink("eve")]


def test_zenoh_reconnects_no_session(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the first session of a process nor a later one: what keys mean would be confused before it is replaced."""
    seen: list[dict[str, Any]] = []

    really_open = zenoh.open

    def opened(config: zenoh.Config) -> zenoh.Session:
        seen.append(json.loads(config.get_json("connect/retry")))
        return really_open(config)

    monkeypatch.setattr(zenoh, "open", opened)
    with Session(stage.eve) as session:
        stage.cable.flap()
        wait_until(lambda: session.connection.openings > 1, "another session")
    assert len(seen) > 1
    day = 24 * 3600 * 1000
    assert all(settings["period_init_ms"] >= day and settings["period_max_ms"] >= day for settings in seen), seen
