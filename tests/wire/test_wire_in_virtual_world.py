"""A whole wire in the simulated world, between simulated programs: `run_wire` as it is, in virtual time."""

from __future__ import annotations

import json
import signal
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import zenoh

from evedrop.system.world import world
from evedrop.virtual.run import SimulatedWorld
from evedrop.virtual.world import EPOCH
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.plan import Side, WireEvent, WirePlan
from evedrop.wire.run import run_wire
from tests.virtual.wire_programs import connected
from tests.wire.wire_at_work import LOSSY, PERFECT, link, plan_of

HOUR = 3600.0
LATE = {**LOSSY, "delay": {"model": "normal", "mean": 0.5, "standard_deviation": 0.2}}
KEYS = ("scan", "pose", "map")
ENDPOINTS = {"robot": "tcp/127.0.0.1:17501", "base": "tcp/127.0.0.1:17502"}

OTHER = {"robot": "base", "base": "robot"}


def plan_with(there: Any = LATE, back: Any = LATE, **fields: Any) -> WirePlan:
    """A wire of two sides, with a link each way."""
    sides = {name: Side(name, (endpoint,)) for name, endpoint in ENDPOINTS.items()}
    return plan_of(link("robot", "base", there), link("base", "robot", back), sides=sides, **fields)


@dataclass
class Outcome:
    """What became of a wire and of the programs at its sides."""

    said: list[str] = field(default_factory=list)
    sent: dict[tuple[str, str], int] = field(default_factory=lambda: defaultdict(int))
    """Side and key → how many messages its programs have sent."""
    got: dict[tuple[str, str], list[int]] = field(default_factory=lambda: defaultdict(list))
    """Side and key → the messages that its reader got from the other side."""
    status: int | None = None
    digest: str = ""
    log: str = ""
    """What the wire wrote to standard error."""
    journal: pa.Table | None = None

    def rows(self, **values: object) -> list[dict[str, Any]]:
        """The rows of the journal with these values."""
        assert self.journal is not None
        return [row for row in self.journal.to_pylist() if all(row[name] == value for name, value in values.items())]


Program = Callable[[], int]


def run(
    seed: int,
    folder: Path,
    plan: WirePlan,
    *,
    seconds: float = 60.0,
    count: int = 100,
    killed_at: float | None = None,
    more: Mapping[str, Program] | None = None,
) -> Outcome:
    """Run a wire for some virtual seconds. A program at each side sends `count` messages on each key, and one reads.

    killed_at: when the wire is killed; a second later it starts again. more: further programs by their names.
    """
    folder.mkdir(exist_ok=True)
    simulated, outcome = SimulatedWorld(seed, lambda _: 1, folder), Outcome()
    scheduler, begin = simulated.scheduler, simulated.machine.begin
    pause, wire_folder = 0.4 * seconds / count, simulated.disk.root / "wire"

    def read(side: str) -> int:
        def take(sample: Any) -> None:
            source, n = json.loads(sample.payload.to_string())
            if source != side:
                outcome.got[side, str(sample.key_expr)].append(n)

        with connected(ENDPOINTS[side]) as session:
            session.declare_subscriber("**", take)
            world().sleep(2.0 * seconds)
        return 0

    def send(side: str) -> int:
        with connected(ENDPOINTS[side]) as session:
            world().sleep(2.0)
            for n in range(count):
                for key in KEYS:
                    session.put(key, json.dumps([side, n]))
                    outcome.sent[side, key] += 1
                world().sleep(scheduler.random.expovariate(1.0 / pause))
            world().sleep(2.0 * seconds)
        return 0

    def wire() -> int:
        return run_wire(plan, wire_folder, seconds=seconds, say=outcome.said.append)

    with simulated.entered():
        wires = [begin("wire", wire)]
        if killed_at is not None:
            scheduler.at(killed_at, lambda: wires[0].signal(signal.SIGKILL))
            scheduler.at(killed_at + 1.0, lambda: wires.append(begin("wire", wire)))
        for side in ENDPOINTS:
            begin(f"reader at {side}", partial(read, side))
            begin(f"sender at {side}", partial(send, side))
        for name, program in (more or {}).items():
            begin(name, program)
        scheduler.run(100 * HOUR, lambda: not wires[-1].task.alive and (killed_at is None or len(wires) == 2))
        outcome.journal = pa.concat_tables(journal_tables(wire_folder))
    assert scheduler.errors == []
    outcome.status, outcome.digest, outcome.log = wires[-1].task.status, scheduler.digest, wires[-1].printed
    return outcome


def assert_true(outcome: Outcome, count: int = 100) -> None:
    """The journal has every message that was sent, and says of each whether its reader got it."""
    assert {*outcome.sent.values()} == {count}
    for (side, key), sent in outcome.sent.items():
        rows = outcome.rows(link=f"{side}-{OTHER[side]}", key=key)
        assert [row["n"] for row in rows] == list(range(sent))
        assert [row["n"] for row in rows if row["fate"] == "delivered"] == sorted(outcome.got[OTHER[side], key])


@pytest.mark.parametrize("seed", range(1, 4))
def test_a_wire_accounts_for_every_message(tmp_path: Path, seed: int) -> None:
    """And what a seed decides it decides again."""
    first, second = (run(seed, folder, plan_with()) for folder in (tmp_path / "first", tmp_path / "second"))
    assert first.status == 0, first.said
    assert_true(first)
    assert first.digest == second.digest
    assert first.got == second.got
    assert first.rows() == second.rows()


@pytest.mark.long
def test_an_hour_of_a_wire_with_a_cut(tmp_path: Path) -> None:
    """From minute 10 to minute 20, on one of its links."""
    outcome = run(1, tmp_path, plan_with(events=(WireEvent(600.0, 1200.0, cut="robot-base"),)), seconds=HOUR)
    assert outcome.status == 0
    assert_true(outcome)
    cut = outcome.rows(reason="cut")
    assert len(cut) > 30
    assert cut == [row for row in outcome.rows(link="robot-base") if EPOCH + 600.0 < row["time"] < EPOCH + 1200.1]


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_wire_that_is_killed_and_starts_again_loses_no_record(tmp_path: Path, seed: int) -> None:
    """The numbers go on. What it passed on has arrived, except just before its death, or before its readers were back."""
    killed_at = 15.0 + seed / 7.0
    outcome = run(seed, tmp_path, plan_with(), killed_at=killed_at)
    assert outcome.status == 0
    assert any("continues start 1" in line for line in outcome.said)
    uncertain = 0
    for side, key in outcome.sent:
        rows = outcome.rows(link=f"{side}-{OTHER[side]}", key=key)
        assert [row["n"] for row in rows] == list(range(len(rows)))
        delivered = [row["time"] + row["delay"] - EPOCH for row in rows if row["fate"] == "delivered"]
        doubtful = sum(killed_at - 0.1 < due < killed_at + 6.0 for due in delivered)
        underway = len([row for row in rows if row["reason"] == "underway"])
        arrived = len(outcome.got[OTHER[side], key])
        assert len(delivered) - doubtful <= arrived <= len(delivered) + underway
        uncertain += max(0, arrived - len(delivered))
    assert uncertain <= 4  # one for each thread that sends


def test_tokens_and_queries_cross(tmp_path: Path) -> None:
    """A token is seen at the other side until its program ends; a question has the answer of the other side."""
    seen: list[tuple[str, bool]] = []
    answers: list[str] = []

    def serve() -> int:
        with connected(ENDPOINTS["base"]) as session:
            session.declare_queryable("service", lambda query: (query.reply("service", b"answer"), query.drop()))
            session.liveliness().declare_token("here")
            world().sleep(20.0)
        return 0

    def ask() -> int:
        with connected(ENDPOINTS["robot"]) as session:
            session.liveliness().declare_subscriber(
                "**",
                lambda sample: seen.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)),
                history=True,
            )
            world().sleep(10.0)
            answers.extend(reply.ok.payload.to_string() for reply in session.get("service", timeout=5.0))
            world().sleep(30.0)
        return 0

    outcome = run(1, tmp_path, plan_with(PERFECT, PERFECT), more={"server": serve, "asker": ask})
    assert outcome.status == 0
    assert_true(outcome)
    assert seen == [("here", True), ("here", False)]
    assert answers == ["answer"]
    assert [(row["kind"], row["fate"]) for row in outcome.rows(key="service")] == [
        ("query", "delivered"),
        ("reply", "delivered"),
    ]
    assert outcome.log == ""
