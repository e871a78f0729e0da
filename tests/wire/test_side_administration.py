"""No program can ask the router of a side what it has, and so stop it: a side has no administration space."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
import zenoh

from evedrop import wire
from evedrop.errors import UsageError
from evedrop.system.ports import free_port
from evedrop.wire.plan import Side
from evedrop.wire.side import SideSession
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import ANYWHERE, at_work, plan_of, program
from tests.wire.wire_at_work import link as one_link

QUESTIONS = ("@/*/router/**", "@/**", "@/*/**", "@/*/session/**", "@/*/router/queryable/**")
ASKED, DECLARED, CROSSED = 300, 2000, 100
"""Without a closed administration space a side stopped after some 40 questions and 4000 declarations."""


@pytest.mark.long
def test_asking_for_the_administration_while_others_declare_stops_no_side(tmp_path: Path) -> None:
    """Three programs behind a tap ask, three declare: nobody answers them, and messages of other sides go on crossing.

    The wire has a process of its own, because a side that has stopped cannot be closed.
    """
    links = [{"from": "robot", "to": "base"}, {"from": "base", "to": "robot"}]
    tap = {"from": "robot", "to": "listener", "tap": True}
    got, replies, asked, declared = [0], list[str](), [0], [0]
    over = threading.Event()

    def count(_: zenoh.Sample) -> None:
        got[0] += 1

    def ask(endpoint: str) -> None:
        with program([endpoint]) as session:
            while not over.is_set():
                for question in QUESTIONS:
                    keys = [str(reply.ok.key_expr) for reply in session.get(question, timeout=5.0) if reply.ok]
                    # A session may look at itself: its own part tells of no other.
                    replies.extend(key for key in keys if not key.startswith(f"@/{session.zid()}/"))
                    asked[0] += 1

    def declare(endpoint: str) -> None:
        with program([endpoint]) as session:
            while not over.is_set():
                queryables = [session.declare_queryable(f"key/{n}", lambda query: query.drop()) for n in range(20)]
                subscribers = [session.declare_subscriber(f"key/{n}", lambda _: None) for n in range(20)]
                declared[0] += len(queryables) + len(subscribers)
                for queryable in queryables:
                    queryable.undeclare()
                for subscriber in subscribers:
                    subscriber.undeclare()

    with (
        wire(side=["robot", "base", "listener"], link=[*links, tap], out=tmp_path / "out") as running,
        program([running.endpoint("robot")]) as robot,
        program([running.endpoint("base")]) as base,
        base.declare_subscriber("scan", count),
    ):
        wait_until(lambda: robot.put("scan", b"") or got[0], "messages cross")
        attackers = [
            threading.Thread(target=attack, args=(running.endpoint("listener"),))
            for attack in (ask, declare)
            for _ in range(3)
        ]
        for attacker in attackers:
            attacker.start()
        try:
            wait_until(
                lambda: robot.put("scan", b"") or (asked[0] >= ASKED and declared[0] >= DECLARED),
                "the attack has lasted long enough; a side that answers stops",
            )
            before = got[0]
            wait_until(lambda: robot.put("scan", b"") or got[0] >= before + CROSSED, "messages go on crossing")
            assert running.status().sides
        finally:
            over.set()
            for attacker in attackers:
                attacker.join(LIMIT)
    assert replies == []


@pytest.mark.parametrize("protected", [False, True], ids=["open", "with users and keys"])
def test_no_side_answers_questions_about_its_router(protected: bool, tmp_path: Path) -> None:
    """With users and keys, and without them."""
    given = {"users": {"ann": "secret"}, "keys": ("robot/**",)} if protected else {}
    login = {"transport": {"auth": {"usrpwd": {"user": "ann", "password": "secret"}}}} if protected else {}
    sides = {"robot": Side("robot", (ANYWHERE,), **given)}  # type: ignore[arg-type]
    with at_work(plan_of(one_link("robot", "base"), sides=sides), tmp_path) as wire_there:
        zids = {name: side.zid for name, side in wire_there.relay.sides.items()}
        with wire_there.program("robot", **login) as robot:
            for question in (*QUESTIONS, *(f"@/{zid}/**" for zid in zids.values())):
                keys = [str(reply.ok.key_expr) for reply in robot.get(question, timeout=5.0) if reply.ok]
                assert [key for key in keys if not key.startswith(f"@/{robot.zid()}/")] == []


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:0", "ws/127.0.0.1:0", "tcp/127.0.0.1:0#so_rcvbuf=65000", "tcp/localhost:0"]
)
def test_a_free_port_that_another_program_takes_first_is_replaced(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The side listens at another one, and programs connect to what it says."""
    with SideSession(Side("first", (ANYWHERE,)), 100) as first:
        taken = int(first.endpoints[0].rpartition(":")[2])
        ports = [taken, free_port()]
        chosen = iter(ports)
        monkeypatch.setattr("evedrop.wire.side.free_port", lambda: next(chosen))
        with SideSession(Side("second", (endpoint,)), 100) as second:
            assert second.endpoints == (endpoint.replace(":0", f":{ports[1]}"),)
            with program(second.endpoints) as there:
                assert [str(zid) for zid in there.info.routers_zid()] == [second.zid]


def test_no_free_port_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """After some attempts, like a port that is taken."""
    with SideSession(Side("first", (ANYWHERE,)), 100) as first:
        taken = int(first.endpoints[0].rpartition(":")[2])
        monkeypatch.setattr("evedrop.wire.side.free_port", lambda: taken)
        with pytest.raises(UsageError, match=r"side second cannot listen at tcp/127\.0\.0\.1:0 "):
            SideSession(Side("second", (ANYWHERE,)), 100)
