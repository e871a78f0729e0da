"""A wire in the simulated world: its links, queues, journal, events and watchdog, in virtual time."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn, cast

import pyarrow as pa
import pytest

from evedrop.system.world import world
from evedrop.virtual.run import SimulatedWorld
from evedrop.virtual.scheduler import VirtualScheduler
from evedrop.virtual.world import EPOCH
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.plan import WireEvent, WirePlan
from evedrop.wire.records import HELD, Kind, WireFate
from evedrop.wire.relay import WireRelay
from evedrop.wire.running_link import RunningLink
from evedrop.wire.send_queue import LAST_SECONDS, SendQueue, waiting_bytes
from evedrop.wire.steering import WireConductor
from evedrop.wire.watchdog import WORK_SECONDS, Watchdog
from tests.wire.wire_at_work import LOSSY, both_ways, link, plan_of

HOUR = 3600.0
LATE = {**LOSSY, "delay": {"model": "normal", "mean": 0.5, "standard_deviation": 0.2}}
KEYS = ("scan", "pose", "map")


@dataclass
class Outcome:
    """What became of a wire."""

    status: int | None
    digest: str
    seconds: float
    """Virtual ones."""
    got: dict[tuple[str, str], list[int]] = field(default_factory=dict)
    """Link and key → the numbers of the messages that its reader got."""
    told: list[str] = field(default_factory=list)
    journal: pa.Table | None = None

    def rows(self, **values: object) -> list[dict[str, Any]]:
        """The rows of the journal with these values."""
        assert self.journal is not None
        return [row for row in self.journal.to_pylist() if all(row[name] == value for name, value in values.items())]


class Wire:
    """The parts of a wire between its sessions, and programs at its sides that send and read without Zenoh."""

    def __init__(self, scheduler: VirtualScheduler, folder: Path, plan: WirePlan, pause: float, count: int) -> None:
        """pause: seconds between two messages of a program, on average; count: its messages."""
        self._scheduler, self.folder, self._plan, self._pause, self._count = scheduler, folder, plan, pause, count
        self.outcome = Outcome(None, "", 0.0)
        self.read: Callable[[], object] = lambda: None
        """What a reader does with a message."""

    def run(self) -> int:
        """The wire's process."""
        plan, told = self._plan, self.outcome.told
        with Watchdog(self._end) as watchdog, WireJournal(self.folder, plan, tell=told.append) as journal:
            links = {link.name: RunningLink(link, plan, journal) for link in plan.links}
            queues = {side: SendQueue(side, plan, journal.records, told.append, most=20) for side in plan.sides}
            watchdog.watch(*(duty for queue in queues.values() for duty in queue.duties))
            relay = cast(WireRelay, SimpleNamespace(apply=partial(_apply, links)))
            with WireConductor(plan, relay, told.append):
                programs = [
                    world().thread(self._send, links[link.name], queues[link.target], journal, key, name=key)
                    for link in plan.links
                    for key in KEYS
                ]
                for program in programs:
                    program.start()
                for program in programs:
                    program.join(100 * HOUR)
                world().sleep(10.0)
            for queue in queues.values():
                queue.end()
            for queue in queues.values():
                queue.close(world().monotonic() + LAST_SECONDS)
        return 0

    def _end(self, problem: str) -> NoReturn:
        self.outcome.told.append(problem)
        world().process.exit(1)

    def _send(self, state: RunningLink, queue: SendQueue, journal: WireJournal, key: str) -> None:
        """What a program sends with a key, as the relay of publications takes it."""
        link, decide = state.link, state.lane("put", key, lossless=False)
        code = journal.words.key_code(key, link.source)
        got = self.outcome.got.setdefault((link.name, key), [])
        for _ in range(self._count):
            world().sleep(self._scheduler.random.expovariate(1.0 / self._pause))
            heard, since = world().time(), world().monotonic()
            n, fate, delay, _ = decide(since, 8)
            row = journal.records.record(
                heard, n, -1, delay, code, 0, 8, link.number, Kind.PUT, fate or WireFate.DELIVERED | HELD
            )
            if not fate:
                task, order = partial(self._arrive, got, n), state.order("put", key)
                queue.send(delay, waiting_bytes(8, key), row, task, patient=True, order=order, since=since)

    def _arrive(self, got: list[int], n: int) -> None:
        self.read()
        got.append(n)
        self._scheduler.note("arrives", n)


def _apply(links: dict[str, RunningLink], moment: Any) -> None:
    for name, state in links.items():
        state.cut = name in moment.cut
        state.change(moment.settings[name])


def run(
    seed: int,
    folder: Path,
    plan: WirePlan,
    *,
    pause: float = 0.1,
    count: int = 100,
    read: Callable[[], object] = lambda: None,
    killed_at: float | None = None,
) -> Outcome:
    """Run a wire to its end in a world of its own, or kill it at a time; read: what a reader does with a message."""
    folder.mkdir(exist_ok=True)
    simulated = SimulatedWorld(seed, lambda _: 1, folder)
    scheduler = simulated.scheduler
    with simulated.entered():
        wire = Wire(scheduler, simulated.disk.root / "wire", plan, pause, count)
        wire.read = read
        process = simulated.machine.begin("wire", wire.run)
        if killed_at is not None:
            scheduler.at(killed_at, lambda: process.signal(signal.SIGKILL))
        scheduler.run(200 * HOUR, lambda: not process.task.alive)
        outcome = wire.outcome
        outcome.journal = pa.concat_tables(journal_tables(wire.folder))
    assert scheduler.errors == []
    outcome.status, outcome.digest, outcome.seconds = process.task.status, scheduler.digest, scheduler.now
    return outcome


def assert_true(outcome: Outcome, count: int = 100) -> None:
    """The journal numbers every message of every stream, and says of each whether its reader got it."""
    assert len(outcome.got) == 2 * len(KEYS)
    for (link_name, key), got in outcome.got.items():
        rows = outcome.rows(link=link_name, key=key)
        assert [row["n"] for row in rows] == list(range(count))
        assert [row["n"] for row in rows if row["fate"] == "delivered"] == sorted(got)


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_journal_says_of_every_message_whether_its_reader_got_it(tmp_path: Path, seed: int) -> None:
    """Messages are lost, and overtake each other; and what a seed decides it decides again."""
    first, second = (run(seed, tmp_path / name, both_ways(LATE, LATE)) for name in ("first", "second"))
    assert first.status == 0
    assert_true(first)
    assert any(got != sorted(got) for got in first.got.values())
    assert {row["reason"] for row in first.rows(fate="lost")} == {"loss"}
    assert first.digest == second.digest
    assert first.got == second.got
    assert first.rows() == second.rows()


def test_another_seed_lets_other_threads_go_on_first(tmp_path: Path) -> None:
    """Messages are lost all the same: a wire's own seed decides that."""
    first, second = (run(seed, tmp_path / str(seed), both_ways(LATE, LATE)) for seed in (1, 2))
    assert first.digest != second.digest
    assert {name: sorted(got) for name, got in first.got.items()} == {
        name: sorted(got) for name, got in second.got.items()
    }


def test_a_link_that_keeps_the_order_keeps_it(tmp_path: Path) -> None:
    """Whichever thread goes on first."""
    plan = plan_of(link("robot", "base", LATE, ordered=True), link("base", "robot", LATE, ordered=True))
    outcome = run(1, tmp_path, plan)
    assert_true(outcome)
    assert all(got == sorted(got) for got in outcome.got.values())


@pytest.mark.thorough
def test_an_hour_of_a_wire_with_a_cut(tmp_path: Path) -> None:
    """From minute 10 to minute 20; the watchdog looks all the time, and finds nothing that hangs."""
    plan = both_ways(LATE, LATE, events=(WireEvent(600.0, 1200.0, cut="robot-base"),))
    outcome = run(1, tmp_path, plan, pause=36.0)
    assert outcome.seconds > HOUR
    assert_true(outcome)
    cut = outcome.rows(reason="cut")
    assert cut
    assert {row["link"] for row in cut} == {"robot-base"}
    within = [row for row in outcome.rows(link="robot-base") if EPOCH + 600.0 < row["time"] < EPOCH + 1200.0]
    assert cut == within
    assert len(outcome.told) == 2


def test_a_reader_that_stops_costs_others_only_some_seconds(tmp_path: Path) -> None:
    """It takes a message every 30 s; what has no room is dropped as congested, and the rest arrives."""
    outcome = run(1, tmp_path, both_ways(), pause=0.05, read=lambda: world().sleep(30.0))
    assert outcome.status == 0
    assert {row["reason"] for row in outcome.rows(fate="dropped")} == {"congested", "underway"}
    assert "have stopped reading" in outcome.told[0]


def test_a_wire_whose_reader_hangs_ends_and_says_where(tmp_path: Path) -> None:
    """After as many virtual seconds as its watchdog allows."""
    outcome = run(1, tmp_path, both_ways(), pause=10.0, read=lambda: world().sleep(100 * HOUR))
    assert outcome.status == 1
    assert WORK_SECONDS <= outcome.seconds < WORK_SECONDS + 10.0
    assert "nothing has moved in what is sent at the side" in outcome.told[-1]


@pytest.mark.parametrize("seed", range(1, 11))
def test_a_killed_wire_leaves_a_true_journal(tmp_path: Path, seed: int) -> None:
    """What it says was delivered has arrived; at most one message for each side has arrived without its saying so."""
    outcome = run(seed, tmp_path, both_ways(LATE, LATE), killed_at=5.0 + seed / 100)
    assert outcome.status == -9
    silent = 0
    for (link_name, key), got in outcome.got.items():
        rows = outcome.rows(link=link_name, key=key)
        assert [row["n"] for row in rows] == list(range(len(rows)))
        delivered = {row["n"] for row in rows if row["fate"] == "delivered"}
        assert delivered <= {*got}
        assert {*got} - delivered <= {row["n"] for row in rows if row["reason"] == "underway"}
        silent += len({*got} - delivered)
    assert silent <= 2


@pytest.mark.parametrize(("pause", "status"), [(0.1, 0), (2.0, 130)])
def test_the_first_signal_stops_a_command_and_a_later_one_ends_it_at_once(
    tmp_path: Path, pause: float, status: int
) -> None:
    """Signals that come at once count as one, as on a real machine."""
    simulated = SimulatedWorld(1, lambda _: 1, tmp_path)
    scheduler = simulated.scheduler
    told: list[str] = []

    def leave() -> NoReturn:
        told.append("leaves")
        world().process.exit(130)

    def command() -> int:
        with world().process.stop_or_leave_on_signals(leave) as stop:
            assert stop.wait(60.0)
            told.append("ends")
            world().sleep(10.0)
        return 0

    with simulated.entered():
        process = simulated.machine.begin("command", command)
        for at in (1.0, 1.0 + pause):
            scheduler.at(at, lambda: process.signal(signal.SIGINT))
        scheduler.run(HOUR, lambda: not process.task.alive)
    assert process.task.status == status
    assert told == (["ends"] if status == 0 else ["ends", "leaves"])
