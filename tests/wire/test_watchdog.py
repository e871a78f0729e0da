"""A wire with a part that hangs still ends: its watchdog ends it and names the part, or a second signal ends it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import zenoh

from evedrop.errors import Interrupted, RunError
from evedrop.system.signals import stop_or_leave_on_signals
from evedrop.wire.file import load_wire
from evedrop.wire.journal import WireJournal
from evedrop.wire.on_disk import summary_of_wire
from evedrop.wire.watchdog import Duty, Watchdog
from tests.conftest import LIMIT, wait_until
from tests.examples import mostly_long
from tests.wire.wire_at_work import program

WIRE = """
seed = 7
[side.robot]
[side.base]
[[link]]
from = "robot"
to = "base"
[[link]]
from = "base"
to = "robot"
"""
REPOSITORY = Path(__file__).parents[2]


class Wire:
    """A wire in its own process, with a part that hangs."""

    def __init__(self, how: str, folder: Path, *options: str) -> None:
        """how: the function of `hanging_wire` that makes it hang; options: of the command."""
        self.file, self.out = folder / "wire.toml", folder / "out"
        self.file.write_text(WIRE)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.wire.hanging_wire", how, str(self.file), "--out", str(self.out), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
        )

    def endpoints(self) -> dict[str, str]:
        """Side → where programs connect, as soon as it is told."""
        assert self.process.stdout is not None
        lines = (self.process.stdout.readline().split() for _ in range(2))
        return {words[0]: words[1] for words in lines}

    def signal(self, number: int) -> bool:
        """Send it a signal; returns whether it has ended."""
        self.process.send_signal(number)
        return self.process.poll() is not None

    def ended(self) -> tuple[int, str]:
        """Its exit status, and what it wrote to standard error, once it has ended."""
        _, errors = self.process.communicate(timeout=LIMIT)
        return self.process.returncode, errors


@contextmanager
def hanging(how: str, folder: Path, *options: str) -> Iterator[Wire]:
    """A wire with a part that hangs; the fixture kills it if it does not end."""
    wire = Wire(how, folder, *options)
    try:
        yield wire
    finally:
        wire.process.kill()
        wire.process.wait(LIMIT)


def put_until_heard(wire: Wire, endpoints: dict[str, str], key: str) -> None:
    """Publish at the side robot until the journal on disk has a message of this key."""
    with program([endpoints["robot"]]) as robot:
        wait_until(
            lambda: robot.put(key, b"x") or ((wire.out / "journal").is_dir() and heard(wire) > 0),
            "the journal has a message",
        )


def heard(wire: Wire) -> int:
    """How many messages the journal on disk has."""
    return summary_of_wire(wire.out).heard if (wire.out / "wire.toml").is_file() else 0


def is_on_disk(wire: Wire) -> None:
    """What the wire heard is on disk, can be read, and the next start goes on from there."""
    summary = summary_of_wire(wire.out)
    assert summary.state == "killed"
    assert summary.heard > 0
    assert not (wire.out / "control.json").exists()
    with WireJournal(wire.out, load_wire(wire.file)) as journal:
        assert journal.recovered == summary.heard
        assert journal.history.start == 2


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("how", "where"),
    [
        pytest.param("a_side", "at the side base", marks=pytest.mark.long),
        ("a_message", "among the messages from the side robot"),
        pytest.param("a_journal", "in the journal", marks=pytest.mark.long),
    ],
)
def test_a_watchdog_ends_a_wire_of_which_a_part_hangs(how: str, where: str, tmp_path: Path) -> None:
    """Status 3, and a sentence that names the part; what is on disk can be used."""
    with hanging(how, tmp_path) as wire:
        endpoints = wire.endpoints()
        with program([endpoints["robot"]]) as robot:
            while wire.process.poll() is None:
                robot.put("scan", b"x")
                robot.put("hang", b"x")
                time.sleep(0.01)
        status, errors = wire.ended()
    assert status == RunError.exit_status
    assert f"the wire no longer answers: nothing has moved {where} for 1 s" in errors
    is_on_disk(wire)


@pytest.mark.long
def test_a_watchdog_ends_a_wire_in_which_zenoh_itself_hangs(tmp_path: Path) -> None:
    """As it does if programs ask a router for what it has while others declare: Zenoh 1.10."""
    over = threading.Event()

    def ask(endpoint: str) -> None:
        with suppress(zenoh.ZError), program([endpoint]) as session:
            while not over.is_set():
                for _ in session.get("@/*/router/**", timeout=1.0):
                    pass

    def declare(endpoint: str) -> None:
        with suppress(zenoh.ZError), program([endpoint]) as session:
            while not over.is_set():
                declared = [session.declare_queryable(f"key/{n}", lambda query: query.drop()) for n in range(20)]
                for queryable in declared:
                    queryable.undeclare()

    with hanging("zenoh", tmp_path) as wire:
        endpoints = wire.endpoints()
        with program([endpoints["robot"]]) as robot:
            wait_until(lambda: robot.put("scan", b"x") or heard(wire), "the journal has a message")
        threads = [
            threading.Thread(target=attack, args=(endpoints["base"],)) for attack in (ask, declare) for _ in range(3)
        ]
        for thread in threads:
            thread.start()
        try:
            status, errors = wire.ended()
        finally:
            over.set()
            for thread in threads:
                thread.join(LIMIT)
    assert status == RunError.exit_status
    assert "the wire no longer answers: nothing has moved at the side base for 1 s" in errors
    is_on_disk(wire)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_one_signal_ends_a_wire_whose_side_cannot_be_closed(number: int, tmp_path: Path) -> None:
    """The watchdog ends it."""
    with hanging("an_end_soon", tmp_path) as wire:
        put_until_heard(wire, wire.endpoints(), "scan")
        wire.signal(number)
        status, errors = wire.ended()
    assert status == RunError.exit_status
    assert "the wire no longer answers: nothing has moved at the side base for 1 s" in errors
    is_on_disk(wire)


@pytest.mark.thorough
@pytest.mark.parametrize("how", mostly_long(["an_end", "a_start"], ["an_end"]))
def test_a_second_signal_ends_a_wire_at_once(how: str, tmp_path: Path) -> None:
    """Whatever the main thread waits for: the end of a session, or a side that cannot be opened."""
    with hanging(how, tmp_path) as wire:
        if how == "an_end":
            put_until_heard(wire, wire.endpoints(), "scan")
        else:
            wait_until((wire.out / "journal" / "unfinished").is_dir, "it opens its sides")
        wait_until(lambda: wire.signal(signal.SIGTERM), "it ends")
        status, errors = wire.ended()
    assert status == Interrupted.exit_status
    assert "interrupted again; the wire has ended with what is on disk" in errors
    if how == "an_end":
        is_on_disk(wire)


@pytest.mark.long
def test_a_view_that_hangs_does_not_change_the_status(tmp_path: Path) -> None:
    """Nor does it keep the process from ending: the wire itself has done all that it should."""
    with hanging("a_view", tmp_path, "--for", "0.2 s", "--view", str(tmp_path / "wire.rrd")) as wire:
        status, errors = wire.ended()
    assert status == 0, errors
    assert summary_of_wire(wire.out).state == "ended"


def ticks(watchdog: Watchdog, count: int) -> list[list[Duty]]:
    """What has hung after each of some ticks."""
    return [watchdog._tick() for _ in range(count)]


def test_a_duty_hangs_if_the_same_thing_is_in_hand_for_its_seconds() -> None:
    """Other things in between, or nothing, are no hang, however long the process stood still between two ticks."""
    watchdog, duty = Watchdog(lambda _: None), Duty("here", seconds=2.0, end_seconds=1.0)
    watchdog.watch(duty)
    assert not any(ticks(watchdog, 10))
    for _ in range(5):
        duty.in_hand = object()
        assert not any(ticks(watchdog, 4))
    assert ticks(watchdog, 1) == [[duty]]
    duty.in_hand = object()
    watchdog.hurry()
    assert ticks(watchdog, 3) == [[], [], [duty]]


def test_a_duty_that_waits_for_others_hangs_only_if_none_of_them_moves() -> None:
    """And then the other one is named."""
    watchdog, other, waiting = Watchdog(lambda _: None), Duty("there", 2.0), Duty("here", 1.0, waits=True)
    watchdog.watch(other, waiting)
    waiting.in_hand = object()
    for _ in range(10):
        other.in_hand = object()
        assert not any(ticks(watchdog, 1))
    assert ticks(watchdog, 4) == [[], [waiting], [waiting], [other, waiting]]


def test_signals_in_quick_succession_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A later one leaves at once, and the handlers of before come back."""
    left: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    with stop_or_leave_on_signals(lambda: left.append(1)) as stop:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGTERM)
        wait_until(stop.is_set, "it stops")
        monkeypatch.setattr("evedrop.system.signals.AGAIN_SECONDS", 0.0)
        os.kill(os.getpid(), signal.SIGTERM)
        wait_until(lambda: left, "it leaves")
    assert signal.getsignal(signal.SIGTERM) == before
