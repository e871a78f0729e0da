"""Questions to the recorder, with real sessions: the operator alone may ask, and the recorder alone may answer.

As in test_access.py nothing waits for silence: a question that is answered proves that what came before it was dealt with.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import zenoh

from evedrop.errors import UsageError
from evedrop.live.network.connection import Question
from evedrop.live.network.control_file import Control
from evedrop.live.network.operator import Answer, Order, ask
from evedrop.live.protocol.brief import AnyBrief, RecorderPart
from evedrop.live.protocol.codec import enclosed, payload_of
from evedrop.live.protocol.keys import COMMAND_BYTES, QUESTION_BYTES, RunKeys
from evedrop.live.protocol.requests import LinkRequest, PauseRequest, StatusRequest, StepRequest
from tests.builders import part_of
from tests.conftest import LIMIT, wait_until
from tests.live.network.bench import Bench, Ear, bench_of, connect, small_network

OTHERS = ("sensor", "legitimate", "eve", "mallory", "nadia")
PATIENCE = 5.0


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One router for all tests of this file, and a recorder that answers."""
    with bench_of(small_network(), tmp_path_factory.mktemp("operator")) as bench:
        yield bench


def operator(stage: Bench) -> AnyBrief:
    """The operator's credentials, as a recorder's brief would have them."""
    recorder = stage.briefs["recorder"]
    return replace(recorder, process="operator", user="operator", password=part_of(recorder, RecorderPart).operator)


def control(stage: Bench, **changes: Any) -> Control:
    """What is in the run's control.json."""
    brief = operator(stage)
    return Control(
        **{"run": brief.run, "router": brief.router, "user": brief.user, "password": brief.password, **changes}
    )


@contextmanager
def answering(stage: Bench) -> Iterator[list[bytes]]:
    """The recorder answers "yes"; what it was asked."""
    key, asked = stage.keys.control("recorder"), list[bytes]()

    def answer(query: zenoh.Query) -> None:
        message = query.payload.to_bytes() if query.payload is not None else b""
        asked.append(payload_of(key, message) or message)
        query.reply(key, enclosed(key, Answer(7, "yes").pack()))
        query.drop()

    queryable = stage.sessions["recorder"].declare_queryable(key, answer)
    wait_until(lambda: ask(control(stage), StatusRequest(), PATIENCE), "a recorder that answers")
    asked.clear()
    yield asked
    queryable.undeclare()


def attempts(stage: Bench) -> list[str]:
    """The key at which the recorder is asked, and wildcards that have it in them."""
    under = f"evedrop/{stage.keys.run}"
    return [stage.keys.control("recorder"), f"{under}/control/*", f"{under}/**", "evedrop/**", "**"]


def replies(session: zenoh.Session, key: str) -> list[bytes]:
    """What a question at a key brings, but for what a session says of itself."""
    question = enclosed(key, PauseRequest().pack())
    samples = [reply.ok for reply in session.get(key, payload=question, timeout=PATIENCE) if reply.ok]
    answers = [(str(sample.key_expr), sample.payload.to_bytes()) for sample in samples]
    return [payload_of(key, message) or message for key, message in answers if not key.startswith("@/")]


def test_the_operator_is_answered(stage: Bench) -> None:
    """Its question reaches the recorder as it was put, and the answer comes back."""
    with answering(stage) as asked:
        assert ask(control(stage), StepRequest(3), PATIENCE) == Answer(7, "yes")
        assert asked == [StepRequest(3).pack()]


def test_what_is_too_large_is_refused_and_not_lost(stage: Bench) -> None:
    """The largest question and the largest answer arrive; of larger ones the operator learns how large they are."""
    key, sizes = stage.keys.control("recorder"), []

    def answer(query: zenoh.Query) -> None:
        assert query.payload is not None
        question = Question(key, query, payload_of(key, query.payload.to_bytes()) or b"")
        order = Order.of(question)
        assert order is not None
        sizes.append(len(question.payload))
        if isinstance(order.request, StepRequest):
            order.done(7, "x" * (COMMAND_BYTES - len(Answer(7, "x" * 2**16).pack()) + 2**16 + order.request.slots - 1))
        else:
            order.done(7, "yes")

    def link(size: int) -> LinkRequest:
        least = len(LinkRequest({"note": "x" * 2**16}).pack()) - 2**16
        return LinkRequest({"note": "x" * (size - least)})

    queryable = stage.sessions["recorder"].declare_queryable(key, answer)
    wait_until(lambda: ask(control(stage), StatusRequest(), PATIENCE), "a recorder that answers")
    sizes.clear()
    assert ask(control(stage), link(QUESTION_BYTES), PATIENCE) == Answer(7, "yes")
    with pytest.raises(UsageError, match=f"has {QUESTION_BYTES + 1} bytes; expected at most {QUESTION_BYTES}"):
        ask(control(stage), link(QUESTION_BYTES + 1), PATIENCE)
    assert sizes == [QUESTION_BYTES]
    largest = ask(control(stage), StepRequest(1), LIMIT)
    assert largest is not None
    assert len(largest.pack()) == COMMAND_BYTES
    larger = ask(control(stage), StepRequest(2), LIMIT)
    assert larger is not None
    assert larger.refused[0].startswith(f"the answer has {COMMAND_BYTES + 1} bytes")
    queryable.undeclare()


@pytest.mark.parametrize("who", OTHERS)
def test_nobody_else_may_ask(who: str, stage: Bench) -> None:
    """Neither sensor nor receiver gets an answer, at the key or any wildcard, and the recorder hears nothing of it."""
    with answering(stage) as asked, connect(stage.briefs[who]) as session:
        for key in attempts(stage):
            assert replies(session, key) == [], key
        assert ask(control(stage), StatusRequest(), PATIENCE) == Answer(7, "yes")
        assert asked == [StatusRequest().pack()]


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_an_eavesdropper_may_not_ask_in_any_mode(mode: str, stage: Bench) -> None:
    """A session that says it is a peer or a router gets as little."""
    changes = {"mode": mode, "listen": {"endpoints": []}}
    with answering(stage) as asked, connect(stage.briefs["eve"], **changes) as session:
        for key in attempts(stage):
            assert replies(session, key) == [], key
        assert ask(control(stage), StatusRequest(), PATIENCE) == Answer(7, "yes")
        assert asked == [StatusRequest().pack()]


@pytest.mark.parametrize("wrong", [{"password": "guessed"}, {"password": ""}, {"user": "trudy"}, {"user": "eve"}])
def test_a_stranger_gets_no_session(wrong: dict[str, str], stage: Bench) -> None:
    """Without the operator's password nothing can be asked."""
    with answering(stage) as asked:
        with pytest.raises(zenoh.ZError):
            ask(control(stage, **wrong), PauseRequest(), PATIENCE)
        assert asked == []


def test_nobody_else_may_answer(stage: Bench) -> None:
    """No other process that offers to answer is asked, with or without the recorder."""
    feigned: list[str] = []
    sessions = [connect(stage.briefs[who]) for who in OTHERS] + [connect(operator(stage))]
    try:
        for session in sessions:
            for key in attempts(stage):
                session.declare_queryable(key, lambda query: feigned.append(str(query.key_expr)))
            # Denied, but answered in its turn: what was declared before has been dealt with.
            assert ask_nothing(session, stage) == []
        with answering(stage) as asked:
            assert ask(control(stage), StatusRequest(), PATIENCE) == Answer(7, "yes")
            assert len(asked) == 1
        assert ask(control(stage), StatusRequest(), PATIENCE) is None
    finally:
        for session in sessions:
            session.close()
    # A session's own questions reach its own queryables; nobody else's did.
    assert set(feigned) <= {stage.keys.journal}


def ask_nothing(session: zenoh.Session, stage: Bench) -> list[bytes]:
    """Ask on a key on which no process answers."""
    return [reply.ok.payload.to_bytes() for reply in session.get(stage.keys.journal, timeout=PATIENCE) if reply.ok]


def test_the_operator_may_do_nothing_else(stage: Bench) -> None:
    """With its credentials nothing can be read, written, answered or feigned on any key: it can only ask."""
    keys = stage.keys
    ear = Ear()
    every = [keys.uplink, keys.journal, *(keys.downlink(name) for name in OTHERS[1:])]
    for name in (*OTHERS, "router", "recorder", "operator"):
        every += [keys.telemetry(name), keys.progress(name), keys.control(name), keys.alive(name)]
    with answering(stage) as asked, connect(operator(stage)) as session:
        for key in (*every, *attempts(stage)):
            session.declare_subscriber(key, ear)
            session.liveliness().declare_subscriber(key, ear, history=True)
        with connect(operator(stage)) as writer:  # its own puts and tokens would reach its own ears
            tokens = [writer.liveliness().declare_token(keys.alive(name)) for name in (*OTHERS, "router", "recorder")]
            for key in every:
                writer.put(key, b"\xc1", congestion_control=zenoh.CongestionControl.BLOCK)
                writer.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
            assert replies(writer, keys.control("recorder")) == [Answer(7, "yes").pack()]
            for token in tokens:
                token.undeclare()
            assert replies(writer, keys.control("recorder")) == [Answer(7, "yes").pack()]
        for name in OTHERS:
            stage.settle(name)
            stage.put("recorder", keys.control(name), b"noted")
            assert stage.controls[name].hear() == (keys.control(name), b"noted")
        assert replies(session, keys.control("recorder")) == [Answer(7, "yes").pack()]
        assert len(asked) == 3
    assert ear.all() == []
    for ears in (stage.downlinks, stage.controls, stage.progress, stage.telemetry):
        assert {name: ear.all() for name, ear in ears.items()} == {name: [] for name in ears}
    assert (stage.journal.all(), stage.tokens.all()) == ([], [])
    assert stage.router.poll() is None


def test_of_another_run_nothing_can_be_asked(stage: Bench) -> None:
    """The operator's rights end with the keys of its run."""
    with answering(stage) as asked, connect(operator(stage)) as session:
        assert replies(session, RunKeys("another").control("recorder")) == []
        assert asked == []
