"""Simulated wires for tests: the fixture `evedrop_simulated_wire`, programs and their clock, and what is refused there."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import queue
import re
import select
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import pytest
import zenoh

from evedrop import wire
from evedrop.cli.simulated import program
from evedrop.errors import RunError, ScenarioError, UsageError
from evedrop.system.disk import REAL_DISK
from evedrop.virtual import caller
from evedrop.virtual.simulated_wire import SimulatedClock, SimulatedWire, SimulatedWires
from evedrop.wire.running import ExpectationFailed

Opener = Callable[..., SimulatedWire]
DOCS = Path(__file__).parents[2] / "docs"
REAL_OPEN, REAL_SLEEP = zenoh.open, time.sleep
WIRE: dict[str, Any] = {
    "side": ["robot", "base"],
    "link": [
        {"name": "radio", "from": "robot", "to": "base", "quality": 0.9},
        {"name": "back", "from": "base", "to": "robot"},
    ],
}
EXPECTATION = {"metric": "radio.delivery", "above": 0.99}
HOUR = 3600.0


def drive(config: zenoh.Config, seconds: float, clock: SimulatedClock, pause: float = 0.1) -> int:
    """A robot's program: it tells its place for some seconds, and returns how often."""
    count = 0
    with zenoh.open(config) as session:
        until = clock.monotonic() + seconds
        while clock.monotonic() < until:
            session.put("place", str(count))
            count += 1
            clock.sleep(pause)
    return count


def listen(config: zenoh.Config, count: int) -> list[int]:
    """A program that waits for so many places."""
    with zenoh.open(config) as session, session.declare_subscriber("place") as places:
        return [int(sample.payload.to_string()) for sample in islice(places, count)]


QUERIES: dict[str, Any] = {
    "side": ["robot", "base"],
    "link": [{"from": "robot", "to": "base"}, {"from": "base", "to": "robot"}],
}


def drives(radio: SimulatedWire, seconds: float, **entries: Any) -> int:
    """Let a robot drive, and wait for it, and for the journal."""
    count = radio.start(drive, radio.config("robot"), seconds, radio.clock, **entries).result()
    radio.clock.sleep(1.0)
    return count


@pytest.mark.campaign
def test_an_hour_of_a_radio(evedrop_simulated_wire: Opener) -> None:
    """Every message has its row, those that arrive are the ones that the journal says, and the wall clock does not count."""
    radio = evedrop_simulated_wire(**WIRE, seconds=2 * HOUR)
    began, real = radio.clock.time(), time.time()
    heard: list[int] = []
    with zenoh.open(radio.config("base")) as base:
        base.declare_subscriber("place", lambda sample: heard.append(int(sample.payload.to_string())))
        count = drives(radio, HOUR, pause=5.0)
    assert count == 720
    assert radio.clock.time() - began >= HOUR
    assert time.time() - real < HOUR
    rows = radio.rows().to_pylist()
    assert [row["n"] for row in rows] == list(range(count))
    assert heard == [row["n"] for row in rows if row["fate"] == "delivered"]
    assert radio.status().links["radio"].heard == count
    assert radio.summary()["links"]["radio"]["delivered"] == len(heard)
    radio.expect("radio.delivery", above=0.85, below=0.95)
    with pytest.raises(ExpectationFailed, match=r"expected radio\.delivery above 0\.99: FAILED"):
        radio.expect("radio.delivery", above=0.99)


def test_a_program_that_ends_without_closing_its_session_has_sent_all(evedrop_simulated_wire: Opener) -> None:
    """As an interpreter that ends; one that is killed has not."""
    radio = evedrop_simulated_wire(**QUERIES)
    kept: list[zenoh.Session] = []

    def tell() -> None:
        kept.append(zenoh.open(radio.config("robot")))
        for number in range(300):
            kept[0].put("place", str(number), congestion_control=zenoh.CongestionControl.BLOCK)

    radio.start(tell).result()
    radio.clock.sleep(1.0)
    assert radio.rows().num_rows == 300


def test_a_program_that_starts_first_waits_for_its_wire(evedrop_simulated_wire: Opener) -> None:
    """Its configuration says so with -1, for as long as it takes."""
    free = "tcp/127.0.0.1:7558"
    first = evedrop_simulated_wire(**QUERIES)
    config = first.config("robot")
    config.insert_json5("connect/endpoints", json.dumps([free]))
    config.insert_json5("connect/timeout_ms", "-1")

    def connect() -> float:
        with zenoh.open(config):
            return first.clock.monotonic()

    early = first.start(connect)
    first.clock.sleep(90.0)
    assert early.is_running
    opened = first.clock.monotonic()
    evedrop_simulated_wire(**{**QUERIES, "side": {"robot": {"listen": free}, "base": {"listen": "tcp/127.0.0.1:7559"}}})
    assert early.result(60.0) >= opened


async def later() -> None:
    """A coroutine."""
    raise AssertionError


def yields() -> Any:
    """A generator."""
    yield 1


@pytest.mark.parametrize("work", [later, yields])
def test_a_program_is_an_ordinary_function(work: Callable[[], Any], evedrop_simulated_wire: Opener) -> None:
    """Nothing would run a coroutine."""
    radio = evedrop_simulated_wire(**QUERIES)
    with pytest.raises(UsageError, match="is no ordinary function"):
        radio.start(work).result()


@pytest.mark.campaign
def test_a_wire_is_steered_while_programs_run(evedrop_simulated_wire: Opener) -> None:
    """At moments of virtual time, as a real one."""
    radio = evedrop_simulated_wire(**WIRE)
    robot = radio.start(drive, radio.config("robot"), 60.0, radio.clock)
    radio.clock.sleep(10.0)
    assert robot.is_running
    radio.cut("radio")
    radio.clock.sleep(10.0)
    radio.heal("radio")
    radio.link("radio", quality=0.0)
    robot.result()
    with pytest.raises(UsageError, match=r"are not partitioned.*nothing was changed"):
        radio.heal("robot", "base")
    lost = radio.typed_summary().links["radio"].lost_by
    assert 98 <= lost["cut"] <= 102
    assert lost["loss"] >= 380
    assert [event["event"] for event in radio.summary()["events"]] == [
        "cut radio",
        "heal radio",
        'link radio: loss = { model = "bernoulli", quality = 0.0 }',
    ]


@pytest.mark.campaign
def test_events_of_the_file_come_in_virtual_time(evedrop_simulated_wire: Opener) -> None:
    """An outage from minute 10 to minute 20 loses ten minutes of messages."""
    radio = evedrop_simulated_wire(**WIRE, event=[{"from": 600, "to": 1200, "cut": "radio"}])
    drives(radio, 1800.0, pause=1.0)
    assert 598 <= radio.typed_summary().links["radio"].lost_by["cut"] <= 602


def test_programs_wait_for_messages(evedrop_simulated_wire: Opener) -> None:
    """Two programs talk, and the test gets what they return."""
    radio = evedrop_simulated_wire(**WIRE)
    base = radio.start(listen, radio.config("base"), 50)
    radio.clock.sleep(1.0)
    robot = radio.start(drive, radio.config("robot"), 600.0, radio.clock)
    heard = base.result()
    assert robot.is_running
    assert heard == sorted(heard)
    assert len(heard) == 50 <= heard[-1]


def test_programs_are_suspended_and_killed(evedrop_simulated_wire: Opener) -> None:
    """As by signals to real ones."""
    radio = evedrop_simulated_wire(**WIRE)
    robot = radio.start(drive, radio.config("robot"), 600.0, radio.clock)
    radio.clock.sleep(10.0)
    robot.send_signal(signal.SIGSTOP)
    radio.clock.sleep(2.0)
    heard = radio.status().links["radio"].heard
    radio.clock.sleep(5.0)
    assert radio.status().links["radio"].heard == heard
    robot.send_signal(signal.SIGCONT)
    radio.clock.sleep(5.0)
    assert radio.status().links["radio"].heard > heard
    robot.kill()
    assert not robot.is_running
    with pytest.raises(RunError, match="drive ended with status -9"):
        robot.result()


def test_a_simulated_radio_loses_what_the_real_one_loses(evedrop_simulated_wire: Opener) -> None:
    """The numbers that the tutorial shows, of processes and real Zenoh: 158 of 200, and which of the first."""
    tutorial = (DOCS / "wire" / "tutorial.md").read_text(encoding="utf-8")
    radio = evedrop_simulated_wire(
        **tomllib.loads(re.findall(r"```toml\n(# radio.toml.*?)```", tutorial, re.DOTALL)[0])
    )
    heard: list[str] = []
    with zenoh.open(radio.config("base")) as base, zenoh.open(radio.config("robot")) as robot:
        base.declare_subscriber("chatter/numbers", lambda sample: heard.append(sample.payload.to_string()))
        radio.clock.sleep(0.1)  # until the side knows of the subscriber
        for number in range(200):
            robot.put("chatter/numbers", str(number))
            radio.clock.sleep(0.01)
        radio.clock.sleep(1.0)
    assert f"\n{len(heard)}\n" in tutorial
    assert f"\n{' '.join(heard[:20])}\n" in tutorial


@pytest.mark.campaign
def test_two_wires_share_a_world(evedrop_simulated_wire: Opener) -> None:
    """A relay program between them passes on what it hears."""
    first, second = evedrop_simulated_wire(**WIRE), evedrop_simulated_wire(**WIRE, seed=2)
    assert first.folder != second.folder

    def relay() -> NoReturn:
        with zenoh.open(first.config("base")) as there, zenoh.open(second.config("robot")) as here:
            there.declare_subscriber("place", lambda sample: here.put("place", sample.payload))
            while True:
                first.clock.sleep(HOUR)

    first.start(relay)
    base = second.start(listen, second.config("base"), 30)
    first.clock.sleep(1.0)
    drives(first, 60.0)
    heard = base.result()
    passed_on = [row["n"] for row in first.rows().to_pylist() if row["fate"] == "delivered"]
    arrived = [row["n"] for row in second.rows().to_pylist() if row["fate"] == "delivered"]
    assert heard == [passed_on[n] for n in arrived][:30]


def test_wires_of_two_tests_at_once_are_in_different_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two worlds of the same order make the same random names."""
    made, make = list[Path](), type(REAL_DISK).make_folder

    def make_folder(disk: Any, folder: Path, *rest: Any, **entries: Any) -> None:
        made.append(folder)
        make(disk, folder, *rest, **entries)

    monkeypatch.setattr(type(REAL_DISK), "make_folder", make_folder)
    for number in range(2):
        with SimulatedWires(program) as wires:
            wires.open(**WIRE, out=tmp_path / str(number))
    first, second = (folder for folder in made if folder.name.startswith("evedrop-wire-"))
    assert first.name == second.name
    assert first != second


def test_a_wire_is_opened_again(evedrop_simulated_wire: Opener) -> None:
    """After its end, and with other endpoints; the second start goes on in the folder of the first."""
    radio = evedrop_simulated_wire(**WIRE)
    first = radio.endpoint("robot")
    with pytest.raises(UsageError, match="runs already"):
        radio.__enter__()
    radio.start(drive, radio.config("robot"), 1.0, radio.clock).result()
    radio.__exit__(None, None, None)
    with radio:
        assert radio.endpoint("robot") != first
        radio.start(drive, radio.config("robot"), 1.0, radio.clock).result()
    assert radio.summary()["start"] == 2
    assert radio.summary()["heard"] > 0


@pytest.mark.campaign
def test_an_order_decides_again_what_it_has_decided(tmp_path: Path) -> None:
    """The same order is the same test to the last digit; another one is another."""

    def rows(order: int, out: Path) -> list[dict[str, Any]]:
        with SimulatedWires(program) as wires:
            radio = wires.open(**WIRE, out=out, order=order)
            drives(radio, 20.0)
            drives(radio, 20.0)
            return list(radio.rows().to_pylist())

    first, again, other = (rows(order, tmp_path / name) for name, order in (("a", 3), ("b", 3), ("c", 4)))
    assert first == again
    assert [row["time"] for row in first] != [row["time"] for row in other]
    assert [row["fate"] for row in first] == [row["fate"] for row in other][: len(first)]


# Misuse


def with_wire(out: Path, use: Callable[[SimulatedWire], object], **entries: Any) -> None:
    """A test that uses a wire."""
    with SimulatedWires(program) as wires:
        use(wires.open(**WIRE, **entries, out=out))


def failing(count: int) -> NoReturn:
    """A program with a mistake."""
    raise ZeroDivisionError(f"after {count}")


def test_a_program_that_fails_fails_the_test(tmp_path: Path) -> None:
    """By `result`, or at the end; the wire has ended in order in both cases."""
    with SimulatedWires(program) as wires:
        radio = wires.open(**WIRE, out=tmp_path / "asked")
        with pytest.raises(ZeroDivisionError, match="after 3"):
            radio.start(failing, 3).result()
    with pytest.raises(ZeroDivisionError, match="after 4"):
        with_wire(tmp_path / "not asked", lambda radio: (radio.start(failing, 4), drives(radio, 1.0)))
    summary = json.loads((tmp_path / "not asked" / "summary.json").read_text())
    assert summary["heard"] > 0
    assert not (tmp_path / "not asked" / "control.json").exists()


@pytest.mark.parametrize(("code", "status"), [(3, 3), ("no listener came", 1), (0, None), (None, None)])
def test_a_program_may_leave_by_sys_exit(evedrop_simulated_wire: Opener, code: Any, status: int | None) -> None:
    """A status that is not 0 is a failure; with 0 it has nothing to return."""
    radio = evedrop_simulated_wire(**WIRE)
    leaving = radio.start(sys.exit, code)
    if status is None:
        with pytest.raises(RunError, match="exit ended with status 0"):
            leaving.result()
    else:
        with pytest.raises(SystemExit, match=str(code)):
            leaving.result()


def test_a_callback_that_fails_fails_the_test(tmp_path: Path) -> None:
    """It runs on a thread of its session, whose errors nobody else would see."""

    def misread(radio: SimulatedWire) -> None:
        with zenoh.open(radio.config("base")) as base:
            base.declare_subscriber("place", lambda sample: int(f"x{sample.payload.to_string()}"))
            drives(radio, 5.0)

    with pytest.raises(RunError, match="ValueError: invalid literal"):
        with_wire(tmp_path / "wire", misread)


def test_the_error_of_the_test_comes_first(tmp_path: Path) -> None:
    """That of a program, and an expectation that failed as well, do not hide it."""

    def fail(radio: SimulatedWire) -> NoReturn:
        radio.start(failing, 4)
        drives(radio, 5.0)
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        with_wire(tmp_path / "wire", fail, expect=[EXPECTATION])
    assert json.loads((tmp_path / "wire" / "summary.json").read_text())["expectations"][0]["held"] is False


@pytest.mark.campaign
def test_an_expectation_of_the_wire_is_judged_at_its_end(tmp_path: Path) -> None:
    """As that of a real one."""
    with pytest.raises(ExpectationFailed, match=r"expected radio\.delivery above 0\.99: FAILED, found 0\.[89]"):
        with_wire(tmp_path / "wire", lambda radio: drives(radio, 60.0), expect=[EXPECTATION])


def test_a_program_that_never_ends_is_waited_for_until_a_limit(evedrop_simulated_wire: Opener) -> None:
    """Whether it goes on, or waits for what never comes; the end of the test ends it."""
    radio = evedrop_simulated_wire(**WIRE)
    for endless in (radio.start(drive, radio.config("robot"), 10 * HOUR, radio.clock, 30.0),
                    radio.start(listen, radio.config("base"), 10**6)):  # fmt: skip
        with pytest.raises(RunError, match=rf"{endless.name} still runs after 60 virtual seconds"):
            endless.result(60.0)


def test_a_program_that_catches_everything_is_ended(tmp_path: Path) -> None:
    """A bare `except` in a loop does not keep the test from its end."""

    def go_on(clock: SimulatedClock) -> NoReturn:
        while True:
            with suppress(BaseException):
                clock.sleep(1.0)

    with SimulatedWires(program) as wires:
        radio = wires.open(**WIRE, out=tmp_path / "wire")
        endless = radio.start(go_on, radio.clock)
        radio.clock.sleep(3.0)
        assert endless.is_running
    assert not endless.is_running


@pytest.mark.campaign
def test_a_wait_for_what_never_comes_ends_with_the_wires(evedrop_simulated_wire: Opener) -> None:
    """A test that waits without a limit, or for longer, learns why; the wire has ended by itself, in order."""
    radio = evedrop_simulated_wire(**WIRE, seconds=600.0)
    radio.start(drive, radio.config("robot"), 10 * HOUR, radio.clock, 30.0)
    with zenoh.open(radio.config("base")) as base:
        nothing = base.declare_subscriber("nothing", zenoh.handlers.FifoChannel(1))
        for moment in ("6[67]", "7[89]"):
            with pytest.raises(UsageError, match=rf"the test still waits after {moment}.* virtual seconds"):
                nothing.recv()
    assert not radio.is_running


def test_a_program_that_spins_is_stopped(evedrop_simulated_wire: Opener, monkeypatch: pytest.MonkeyPatch) -> None:
    """No time passes while it asks for the time without sleeping, or sends without waiting."""
    monkeypatch.setattr(caller, "_MOST_TURNS", 2000)
    radio = evedrop_simulated_wire(**WIRE)

    def spin() -> None:
        until = radio.clock.monotonic() + 1.0
        while radio.clock.monotonic() < until:
            pass

    def flood() -> NoReturn:
        with zenoh.open(radio.config("robot")) as session:
            while True:
                session.put("flood", b"")

    with pytest.raises(UsageError, match="no time passes while a program asks for it"):
        radio.start(spin).result()
    flooding = radio.start(flood)
    with pytest.raises(UsageError, match=r"at .* virtual seconds, no time passes: a program goes on without waiting"):
        flooding.result()


def run_a_coroutine() -> None:
    """Wait for one that takes no time."""
    with closing(asyncio.sleep(0)) as coroutine:
        asyncio.run(coroutine)


def run_a_loop() -> None:
    """As a program does that has made it before."""
    with closing(asyncio.new_event_loop()) as loop:
        loop.run_forever()


@pytest.mark.parametrize(
    ("wait", "named"),
    [
        (lambda: time.sleep(0.1), "time.sleep"),
        (lambda: threading.Event().wait(0.1), "a wait of threading or queue"),
        (lambda: queue.Queue[int]().get(timeout=0.1), "a wait of threading or queue"),
        (lambda: threading.Thread(target=print).start(), "threading.Thread.start"),
        (lambda: subprocess.run(["true"], check=True), "subprocess.Popen"),
        (lambda: os.system("true"), "os.system"),  # noqa: S605 - refused
        (lambda: os.fork(), "os.fork"),  # noqa: PLW0108 - the function of that moment
        (lambda: os.posix_spawn("/bin/true", ["true"], {}), "os.posix_spawn"),
        (lambda: multiprocessing.get_context("spawn").Process(target=print).start(), "a process of multiprocessing"),
        (lambda: select.select([], [], [], 0.1), "select.select"),
        (run_a_coroutine, "asyncio.run"),
        (run_a_loop, "an event loop of asyncio"),
        (lambda: select.poll().poll(0), "select.poll"),
        (lambda: wire(**WIRE).__enter__(), "subprocess.Popen"),
    ],
)
def test_what_takes_real_time_is_refused(
    evedrop_simulated_wire: Opener, wait: Callable[[], object], named: str
) -> None:
    """In programs and in the test itself, with what to do instead."""
    radio = evedrop_simulated_wire(**WIRE)
    with pytest.raises(UsageError, match=f"{named} in the simulated world.*`clock.sleep`"):
        radio.start(wait).result()
    with pytest.raises(UsageError, match=f"{named} in the simulated world.*`clock.sleep`"):
        wait()


def test_what_the_wire_itself_needs_is_not_refused(tmp_path: Path) -> None:
    """Such as the threads and processes with which its report looks for fonts on a new machine."""
    done: list[int] = []

    def command(words: Sequence[str]) -> int:
        thread = threading.Thread(target=time.sleep, args=(0.0,))
        thread.start()
        thread.join()
        done.append(subprocess.run(["true"], check=True).returncode)
        return program(words)

    with SimulatedWires(command) as wires:
        wires.open(**WIRE, out=tmp_path / "wire")
    assert done == [0]


def test_a_side_with_users_is_for_them(evedrop_simulated_wire: Opener) -> None:
    """A configuration has the first user's name and password, or another's; without one, nobody connects."""
    users = {"ada": "first", "bob": "second"}
    radio = evedrop_simulated_wire(**{**WIRE, "side": {"robot": {"users": users}, "base": {}}})
    for config, user in ((radio.config("robot"), "ada"), (radio.config("robot", "bob"), "bob")):
        assert json.loads(config.get_json("transport/auth/usrpwd/user")) == user
        assert json.loads(config.get_json("transport/auth/usrpwd/password")) == users[user]
        assert radio.start(drive, config, 1.0, clock=radio.clock).result() == 10
    with pytest.raises(UsageError, match="side \"robot\" has no user 'eve'; expected ada or bob"):
        radio.config("robot", "eve")
    with pytest.raises(UsageError, match="has no user 'ada'; expected none"):
        radio.config("base", "ada")
    stranger = radio.config("base")
    stranger.insert_json5("connect/endpoints", json.dumps([radio.endpoint("robot")]))
    with pytest.raises(zenoh.ZError):
        radio.start(zenoh.open, stranger).result()


def test_the_real_zenoh_does_not_find_a_simulated_wire(evedrop_simulated_wire: Opener) -> None:
    """A program that has kept `zenoh.open` from before cannot connect, and what is not simulated is refused by name."""
    radio = evedrop_simulated_wire(**WIRE)
    with pytest.raises(zenoh.ZError):
        radio.start(REAL_OPEN, radio.config("robot")).result()
    with (
        zenoh.open(radio.config("robot")) as robot,
        pytest.raises(TypeError, match=r"DefaultHandler.* not simulated"),
    ):
        robot.declare_subscriber("place", zenoh.handlers.DefaultHandler())


def test_ctrl_c_in_a_program_is_for_the_test(tmp_path: Path) -> None:
    """It ends what the test waits for, not only the program that went on just then."""

    def interrupted(radio: SimulatedWire) -> NoReturn:
        with pytest.raises(KeyboardInterrupt):
            radio.start(signal.raise_signal, signal.SIGINT).result()
        assert radio.status().seconds < 1.0
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        with_wire(tmp_path / "wire", interrupted)


def test_mistakes_are_said_before_the_world_begins(tmp_path: Path) -> None:
    """As by a real wire; a folder that is in use is refused by the command."""
    with SimulatedWires(program) as wires:
        with pytest.raises(ScenarioError, match=r'link\.0\.to: is "base"'):
            wires.open(**{**WIRE, "side": ["robot", "desk"]}, out=tmp_path / "wire")
        assert list(tmp_path.iterdir()) == []
        (tmp_path / "notes.txt").write_text("mine")
        with pytest.raises(UsageError, match="is not empty"):
            wires.open(**WIRE, out=tmp_path)


def test_afterwards_all_is_as_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What programs print is the test's output; what takes real time works again."""
    streams = sys.stdout, sys.stderr
    with SimulatedWires(program) as wires:
        radio = wires.open(**WIRE, out=tmp_path / "wire")
        radio.start(print, "from the robot").result()
        sys.stdout.write("from the test\n")
        endpoint = radio.endpoint("robot")
        assert endpoint.startswith("tcp/127.0.0.1:")
    assert capsys.readouterr().out == "from the robot\nfrom the test\n"
    assert (sys.stdout, sys.stderr) == streams
    assert (zenoh.open, time.sleep) == (REAL_OPEN, REAL_SLEEP)
    thread = threading.Thread(target=time.sleep, args=(0.0,))
    thread.start()
    thread.join()


BOTH = """
def test_both(evedrop_wire, evedrop_simulated_wire):
    raise AssertionError("it runs")


def test_one(evedrop_simulated_wire, request):
    WIRE = {"side": ["a", "b"], "link": [{"from": "a", "to": "b"}]}
    assert evedrop_simulated_wire(**WIRE).folder.name == "wire-1"
    assert evedrop_simulated_wire(**WIRE).folder.name == "wire-2"
    assert len(request.node.user_properties) == 2
"""


@pytest.mark.campaign
def test_the_fixture_is_one_of_the_plugin(tmp_path: Path) -> None:
    """In a project of others; a test cannot have both kinds of wires."""
    (tmp_path / "test_both.py").write_text(BOTH)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert "a test has either evedrop_wire or evedrop_simulated_wire" in done.stdout
    assert "1 passed, 1 error" in done.stdout


def test_an_attachment_may_be_text(evedrop_simulated_wire: Opener) -> None:
    """As on a real session."""
    radio = evedrop_simulated_wire(**WIRE)
    heard: list[tuple[str, str]] = []
    with zenoh.open(radio.config("base")) as base, zenoh.open(radio.config("robot")) as robot:
        base.declare_subscriber(
            "place",
            lambda sample: heard.append(
                (sample.payload.to_string(), (sample.attachment or zenoh.ZBytes()).to_string())
            ),
        )
        radio.clock.sleep(1.0)
        for n in range(20):
            robot.put("place", str(n), attachment="frame 1")
        radio.clock.sleep(1.0)
    assert heard
    assert {attachment for _, attachment in heard} == {"frame 1"}


def test_a_question_has_its_answers_once_nobody_holds_it(evedrop_simulated_wire: Opener) -> None:
    """As on a real session: at once, and with the parameters of the selector; also within `with`."""
    radio = evedrop_simulated_wire(**QUERIES)
    with zenoh.open(radio.config("base")) as base, zenoh.open(radio.config("robot")) as robot:
        base.declare_queryable("pose", lambda query: query.reply("pose", f"here {query.parameters}"))

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply("map", str(query.selector))

        base.declare_queryable("map", answer)
        radio.clock.sleep(1.0)
        began = radio.clock.time()
        answers = [
            [reply.ok.payload.to_string() for reply in robot.get(asked) if reply.ok is not None]
            for asked in ("pose", "pose?x=1", "map?y=2")
        ]
        assert radio.clock.time() - began < 1.0
    assert answers == [["here "], ["here x=1"], ["map?y=2"]]


@pytest.mark.parametrize("declared", ["subscriber", "publisher", "queryable", "querier"])
def test_what_is_no_key_expression_is_refused_at_once(evedrop_simulated_wire: Opener, declared: str) -> None:
    """By the session that is asked, and not somewhere in the wire."""
    radio = evedrop_simulated_wire(**QUERIES)
    with zenoh.open(radio.config("base")) as base:
        handlers = {"subscriber": [print], "queryable": [print]}.get(declared, [])
        for act in (
            lambda: getattr(base, f"declare_{declared}")("x#y", *handlers),
            lambda: base.put("x#y", "1"),
            lambda: base.get("x#y"),
            lambda: base.liveliness().declare_token("x#y"),
        ):
            with pytest.raises(zenoh.ZError):
                act()
