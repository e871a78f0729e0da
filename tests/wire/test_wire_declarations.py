"""Declarations of programs cross a wire, however many, and while others declare; routers that join sides are found."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.wire.plan import Side
from evedrop.wire.records import WireFate
from tests.conftest import wait_until
from tests.wire.wire_at_work import ANYWHERE, WireAtWork, at_work, both_ways, link, plan_of

PAGE = Path(__file__).parents[2] / "docs" / "wire" / "semantics.md"


def alive(session: zenoh.Session, key: str = "**") -> list[str]:
    """The tokens that a program sees."""
    replies = session.liveliness().get(key, zenoh.handlers.FifoChannel(10_000), timeout=5.0)
    return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})


def test_more_tokens_cross_than_a_channel_of_zenoh_holds(tmp_path: Path) -> None:
    """A side that shows 600 tokens while programs of both sides declare more stays alive, and everything crosses."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        held: list[zenoh.LivelinessToken] = []

        def declare(session: zenoh.Session, name: str) -> None:
            held.extend(session.liveliness().declare_token(f"{name}/{n}") for n in range(300))

        threads = [threading.Thread(target=declare, args=way) for way in ((robot, "a"), (base, "b"), (robot, "c"))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(alive(robot)) == len(alive(base)) == 900, "all tokens are seen from both sides")
        held.clear()
    assert not wire.told


def wire_knows(wire: WireAtWork, side: str) -> bool:
    """Whether the wire knows that a program at a side holds the token."""
    return "both" in wire.relay._liveliness.tokens[side]


def test_matching_status_is_always_true(tmp_path: Path) -> None:
    """Without any program at the other side, as docs/wire/semantics.md says: what the wire itself declares matches everything."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as robot:
        publisher, querier = robot.declare_publisher("no/sub"), robot.declare_querier("no/such")
        wait_until(lambda: _matches(publisher) and _matches(querier), "both match")
    assert "| matching status of publishers and queriers | **always true**" in PAGE.read_text(encoding="utf-8")


def _matches(declared: Any) -> bool:
    status = declared.matching_status
    return bool(status.matching)


def test_the_same_token_at_both_sides_lives_as_long_as_one_of_its_programs(tmp_path: Path) -> None:
    """Whichever ends first, the token of the other is seen from both sides in the end, and then it is gone."""
    with at_work(both_ways(), tmp_path) as wire, wire.program("robot") as first_program, wire.program("base") as other:
        for first, second in ((first_program, other), (other, first_program)):
            token = first.liveliness().declare_token("both")
            wait_until(lambda: alive(first_program) == alive(other) == ["both"], "both see it")
            further = second.liveliness().declare_token("both")
            token.undeclare()
            knows = partial(wire_knows, wire, "base" if second is other else "robot")
            wait_until(knows, "the wire finds the second")
            wait_until(lambda: alive(first_program) == alive(other) == ["both"], "both see that of the second")
            further.undeclare()
            wait_until(lambda: not alive(first_program) and not alive(other), "it is gone")


@contextmanager
def router(*connect: str) -> Iterator[tuple[zenoh.Session, str]]:
    """A router outside the wire, and where to reach it."""
    config = {
        "mode": "router",
        "listen": {"endpoints": [ANYWHERE]},
        "connect": {"endpoints": list(connect)},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": True},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        told = [
            reply.ok.payload.to_bytes() for reply in session.get(f"@/{session.zid()}/router") if reply.ok is not None
        ]
        yield session, json.loads(told[0])["locators"][0]


@pytest.mark.parametrize("lossless", [(), ("a",)], ids=["lossy", "lossless"])
def test_sides_that_routers_join_outside_the_wire_carry_nothing(tmp_path: Path, lossless: tuple[str, ...]) -> None:
    """Each side has a router of its own, and these are connected with each other: without the wire, too, everything passes.

    Lossless messages do not cross either: it would go round forever.
    """
    with router() as (_, first), router(first) as (_, second):
        sides = {"robot": Side("robot", (ANYWHERE,), (first,)), "base": Side("base", (ANYWHERE,), (second,))}
        plan = replace(plan_of(link("robot", "base"), link("base", "robot"), sides=sides), lossless=lossless)
        with at_work(plan, tmp_path) as wire, wire.program("robot") as robot:
            wait_until(lambda: wire.told, "the wire says so")
            assert (
                "messages pass between the sides robot and base outside the wire, through the routers" in wire.told[0]
            )
            robot.put("a", b"x")
            wait_until(lambda: WireFate.LOOPED in wire.fates("robot-base"), "the journal calls it looped")
            assert all(fate == WireFate.LOOPED for fate in wire.fates())


@pytest.mark.thorough
def test_a_program_cannot_say_that_sides_are_joined(tmp_path: Path) -> None:
    """Each side has a router of its own; a probe of the wire that one program reads, another puts at the other side, too late."""
    with router() as (_, first), router() as (_, second):
        sides = {"robot": Side("robot", (ANYWHERE,), (first,)), "base": Side("base", (ANYWHERE,), (second,))}
        with (
            at_work(plan_of(link("robot", "base"), sides=sides), tmp_path) as wire,
            wire.program("robot") as spy,
            wire.program("base") as forger,
            wire.program("base") as witness,
        ):
            probes: list[tuple[str, bytes]] = []
            spy.declare_subscriber(
                "@evedrop/*/*", lambda probe: probes.append((str(probe.key_expr), probe.payload.to_bytes()))
            )
            wait_until(lambda: probes, "the wire probes")
            forged: list[str] = []
            witness.declare_subscriber("forged", lambda sample: forged.append(sample.payload.to_string()))
            key, old = probes[0]
            wait_until(lambda: old not in wire.relay._neighbours._sent, "the first probe is too old")
            assert len({payload for _, payload in probes}) == len(probes) > 1
            for payload in (old, b"", bytes(len(old)), bytes(len(old) + 1)):
                forger.put(key, payload)
            wait_until(lambda: forger.put("forged", b"") or forged, "what was forged is at the side")
            count = len(probes)
            wait_until(lambda: len(probes) > count + 3, "the wire looks again")
            spy.put("a", b"x")
            wait_until(lambda: len(wire.rows_of("a")) == 1, "the wire hears")
            assert wire.rows_of("a")["fate"].tolist() == [WireFate.DELIVERED]
            assert not wire.told


@pytest.mark.long
def test_a_program_that_passes_probes_on_joins_no_side_without_a_router(tmp_path: Path) -> None:
    """Even if it does so at once: routers join sides, and there is none."""
    with router() as (_, first), router() as (_, second):
        sides = {"robot": Side("robot", (ANYWHERE,), (first,)), "base": Side("base", (ANYWHERE,), (second,))}
        plan = plan_of(link("robot", "base"), link("robot", "third"), sides=sides)
        with at_work(plan, tmp_path) as wire, wire.program("robot") as spy, wire.program("third") as forger:
            neighbours = wire.relay._neighbours
            spy.declare_subscriber("@evedrop/*/*", lambda probe: forger.put(probe.key_expr, probe.payload))
            wait_until(lambda: neighbours._passes("robot", "third"), "a probe was passed on")
            looks = {*neighbours._sent}
            wait_until(lambda: not looks & {*neighbours._sent}, "the wire looks again and again")
            assert neighbours._passes("robot", "third")
            spy.put("a", b"x")
            wait_until(lambda: len(wire.fates("robot-third")) == 1, "the wire hears")
            assert wire.fates("robot-third") == [WireFate.DELIVERED]
            assert not wire.told


def test_routers_that_do_not_join_sides_are_no_loop(tmp_path: Path) -> None:
    """Each side may have a router of its own, as robots have."""
    with router() as (session, first), router() as (other, second):
        sides = {"robot": Side("robot", (ANYWHERE,), (first,)), "base": Side("base", (ANYWHERE,), (second,))}
        with at_work(plan_of(link("robot", "base"), sides=sides), tmp_path) as wire:
            heard: list[bytes] = []
            other.declare_subscriber("a", lambda sample: heard.append(sample.payload.to_bytes()))

            def crossed() -> bool:
                session.put("a", b"x")
                return bool(heard)

            wait_until(crossed, "a message crosses from router to router")
            assert not wire.told
            assert set(wire.fates()) == {WireFate.DELIVERED}
