"""Programs that stop reading hold up nobody at another side: real programs, which stop at their first message."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from evedrop.live.network.control_file import read_control
from evedrop.live.network.operator import ask
from evedrop.live.protocol.requests import StatusRequest
from evedrop.wire.on_disk import scorekeeper_on_disk
from evedrop.wire.publications import publish
from evedrop.wire.records import WireFate
from evedrop.wire.relay import open_sides
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.send_queue import SendQueue
from evedrop.wire.side import ZenohConfig, side_config
from tests.conftest import LIMIT, Evedrop, wait_until
from tests.wire.test_publications import reader
from tests.wire.wire_at_work import at_work, is_declared, link, plan_of, program

BLOCK = zenoh.CongestionControl.BLOCK
COUNT, LARGE = 100, 200_000
"""More than the buffers of a connection hold."""
FOREVER = 10**9
"""Microseconds."""
PATIENT = {"link": {"tx": {"lease": 10**6, "queue": {"congestion_control": {"block": {"wait_before_close": FOREVER}}}}}}
"""The transport of a program that does not give its connection up, however slow the machine is: by default Zenoh does so if a
message waits for 5 s, or if nothing comes for 10 s."""
PROGRAM = """
import os, signal, sys
import zenoh
from tests.wire.wire_at_work import program

what, endpoint = sys.argv[1:]
stop = lambda _: os.kill(os.getpid(), signal.SIGSTOP)
# A program that lives and does not read, however slow the machine is, and has little room for what it did not read.
transport = {"link": {"tx": {"lease": 1000000}, "tcp": {"so_rcvbuf": 65536}}}
with program([endpoint], transport=transport) as session:
    if what == "reads":
        session.declare_subscriber("**", zenoh.handlers.Callback(stop, indirect=False))
    else:
        session.get("map", zenoh.handlers.Callback(stop, indirect=False), timeout=1000.0)
    print("begun", flush=True)
    sys.stdin.readline()
"""
THREE_SIDES = """
[side.robot]
[side.base]
[side.third]
[[link]]
from = "robot"
to = "base"
[[link]]
from = "robot"
to = "third"
"""


@contextlib.contextmanager
def stopping(case: str, endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A program that `reads`, or `asks` for the map, and stops as soon as anything comes."""
    command = [sys.executable, "-c", PROGRAM, case, endpoint]
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "begun\n"
            yield process
        finally:
            process.kill()


@pytest.fixture(autouse=True)
def _patient_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    """A side waits for a program that does not read until it ends, and not 5 s for each of many such programs."""

    def patient(*arguments: Any) -> ZenohConfig:
        config = side_config(*arguments)
        queue = {"congestion_control": {"block": {"wait_before_close": FOREVER}}}
        link = {**config["transport"]["link"], "tx": {"lease": 10**6, "queue": queue}, "tcp": {"so_sndbuf": 65536}}
        return {**config, "transport": {**config["transport"], "link": link}}

    monkeypatch.setattr("evedrop.wire.side.side_config", patient)


@pytest.mark.thorough
@pytest.mark.parametrize("tap", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_stopped_reader_at_a_third_side_holds_up_nobody(tap: bool, tmp_path: Path) -> None:
    """The base has all messages although Zenoh waits for the readers."""
    plan = plan_of(link("robot", "base"), link("robot", "third", tap=tap), link("base", "robot"))
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot", transport=PATIENT) as robot,
        wire.program("base", transport=PATIENT) as base,
        contextlib.ExitStack() as readers,
    ):
        got = reader(base, "scan")
        wait_until(lambda: is_declared(wire, "base", "subscriber", "scan"), "the base reads")
        for _ in range(3):
            readers.enter_context(stopping("reads", wire.relay.endpoints["third"][0]))
        wait_until(lambda: is_declared(wire, "third", "subscriber", "scan"), "the others read")
        for n in range(COUNT):
            robot.put("scan", str(n).encode().ljust(LARGE), congestion_control=BLOCK)
        wait_until(lambda: len(got) == COUNT, lambda: f"the base has all, not {len(got)}; {wire.fates('robot-base')}")
        assert [int(sample.payload.to_bytes()) for sample in got] == [*range(COUNT)]
        assert wire.fates("robot-base") == [WireFate.DELIVERED] * COUNT


@pytest.mark.thorough
def test_a_stopped_asker_holds_up_nobody_at_the_side_that_answers(tmp_path: Path) -> None:
    """What the server publishes reaches the robot while its replies still wait for the asker."""
    plan = plan_of(
        link("base", "robot"), link("robot", "base"), link("base", "third"), link("third", "base"), query_seconds=LIMIT
    )
    with (
        at_work(plan, tmp_path) as wire,
        wire.program("robot", transport=PATIENT) as robot,
        wire.program("base", transport=PATIENT) as base,
    ):
        got = reader(robot, "pose")
        wait_until(lambda: is_declared(wire, "robot", "subscriber", "pose"), "the robot reads")
        answered: list[int] = []

        def answer(query: zenoh.Query) -> None:
            with query:
                for n in range(COUNT):
                    query.reply("map", bytes(LARGE))
                    answered.append(n)

        base.declare_queryable("map", answer)
        wait_until(lambda: is_declared(wire, "base", "queryable", "map"), "the base answers")
        with stopping("asks", wire.relay.endpoints["third"][0]):
            wait_until(lambda: len(answered) == COUNT, "all replies are on their way")
            base.put("pose", b"", congestion_control=BLOCK)
            wait_until(lambda: got, "the pose crosses")


def test_no_message_overtakes_those_that_wait_for_their_turn(tmp_path: Path) -> None:
    """Those that Zenoh may drop go past the queue only while it is empty."""
    plan = plan_of(link("robot", "base"), link("robot", "third"))
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot, wire.program("base") as base:
        got = reader(base, "scan")
        wait_until(lambda: is_declared(wire, "base", "subscriber", "scan"), "the base reads")
        for n in range(2001):
            robot.put("scan", str(n).encode(), congestion_control=zenoh.CongestionControl.DROP if n % 2 else BLOCK)
        wait_until(lambda: got and got[-1].payload.to_bytes() == b"2000", "the last one arrives")
        numbers = [int(sample.payload.to_bytes()) for sample in got]
        assert numbers == sorted(numbers)
        assert {*range(0, 2001, 2)} <= {*numbers}


def test_each_message_to_a_side_that_has_stopped_has_a_fate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that find no room are congested; the summary of the wire is that of its journal, also at its end."""
    monkeypatch.setattr("evedrop.wire.relay.SendQueue", partial(SendQueue, most=8, patience=0.1))
    monkeypatch.setattr("evedrop.wire.relay.LAST_SECONDS", 0.1)
    plan, takes = plan_of(link("robot", "base"), link("robot", "third")), threading.Event()
    with at_work(plan, tmp_path) as wire, wire.program("robot") as robot:
        third = wire.relay.sides["third"].session

        def stops(session: zenoh.Session, *message: Any) -> None:
            if session is third:
                assert takes.wait(LIMIT)
            publish(session, *message)

        monkeypatch.setattr("evedrop.wire.publications.publish", stops)
        scorekeeper = WireScorekeeper(plan, wire.journal)
        for _ in range(COUNT):
            robot.put("scan", b"", congestion_control=BLOCK)
        wait_until(lambda: len(wire.rows) == 2 * COUNT, "the wire hears all")
        assert len(wire.told) == 1
    takes.set()
    assert scorekeeper.unaccounted == 0
    live, on_disk = scorekeeper.links(), scorekeeper_on_disk(tmp_path, plan).links()
    assert live["robot-base"].delivered == on_disk["robot-base"].delivered == COUNT
    for links in (live, on_disk):
        assert links["robot-third"].dropped_by == {"congested": COUNT - 9, "underway": 9}
        assert (links["robot-third"].heard, links["robot-third"].delivered) == (COUNT, 0)
        assert links["robot-third"].rate == 1.0


@pytest.mark.long
def test_a_wire_ends_although_programs_have_stopped_reading(evedrop: Evedrop) -> None:
    """Upon SIGTERM; each message has a fate."""
    (evedrop.folder / "robot.toml").write_text(THREE_SIDES)
    wire = evedrop.started("wire", "robot.toml")
    control = wire.folder / "control.json"
    wait_until(lambda: control.exists() or wire.process.poll() is not None, "a wire that can be asked")
    answer = ask(read_control(wire.folder), StatusRequest(), LIMIT)
    assert answer is not None
    assert answer.wire is not None
    sides = answer.wire.sides
    arrived: list[zenoh.Sample] = []
    with stopping("reads", sides["third"][0]), program(sides["robot"]) as robot, program(sides["base"]) as base:
        base.declare_subscriber("scan", arrived.append)
        wait_until(
            lambda: robot.put("scan", bytes(LARGE), congestion_control=BLOCK) or len(arrived) > COUNT, "many arrive"
        )
        os.kill(wire.process.pid, signal.SIGTERM)
        out, errors = wire.process.communicate(timeout=LIMIT)
    assert wire.process.returncode == 0, out + errors
    summary = json.loads((wire.folder / "summary.json").read_text())
    assert summary["unaccounted"] == 0
    for account in summary["links"].values():
        assert account["heard"] == account["delivered"] + sum(account["dropped_by"].values())


CROWDED = """
import sys, threading
from pathlib import Path
import zenoh
from evedrop.wire import publications
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import at_work, link, plan_of

goes_on, publish = threading.Event(), publications.publish

def hangs(session, sample, *how):
    if str(sample.key_expr) == "flood":
        assert goes_on.wait(LIMIT)
    publish(session, sample, *how)

publications.publish = hangs
with at_work(plan_of(link("a", "b"), link("c", "d")), Path(sys.argv[1])) as wire:
    flooding = [wire.program("a") for _ in range(8)]
    with wire.program("c") as sender, wire.program("d") as receiver:
        got = []
        receiver.declare_subscriber("pose", got.append)
        wait_until(lambda: sender.put("pose", b"") or got, "the sides c and d are connected")
        for program in flooding:
            for _ in range(2000):
                program.put("flood", bytes(1000))
        begun = len(got)
        wait_until(lambda: sender.put("pose", b"") or len(got) > begun + 100, "the sides c and d go on")
        goes_on.set()
    for program in flooding:
        program.close()
"""


@pytest.mark.long
def test_many_senders_that_wait_hold_up_no_other_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each holds a thread of Zenoh, which has two by default, and starts them with the first session of a process."""
    monkeypatch.delenv("ZENOH_RUNTIME", raising=False)
    command = [sys.executable, "-c", CROWDED, str(tmp_path)]
    subprocess.run(command, cwd=Path(__file__).parents[2], timeout=2 * LIMIT, check=True)


@pytest.mark.parametrize(("given", "used"), [(None, "(rx: (worker_threads: 32))"), ("(rx: (worker_threads: 3))",) * 2])
def test_the_users_own_runtime_of_zenoh_is_kept(
    given: str | None, used: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`ZENOH_RUNTIME` gives a wire more threads that receive, or fewer."""
    monkeypatch.setenv("ZENOH_RUNTIME", given or "")
    if given is None:
        monkeypatch.delenv("ZENOH_RUNTIME")
    with open_sides(plan_of(link("robot", "base"))):
        pass
    assert os.environ["ZENOH_RUNTIME"] == used
