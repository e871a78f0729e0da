"""Ctrl-C, SIGTERM and SIGHUP at any moment, of every command: status 130, results that can be read, no traceback, no process."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from evedrop.results.crash_proof_tables import last_round
from evedrop.results.folder import UNFINISHED
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.system.ports import free_port
from tests.by_hand import by_hand
from tests.conftest import LIMIT, Done, Evedrop, Live, wait_until
from tests.examples import mostly_long
from tests.processes import catches

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ENDLESS = ("--slots", "1000000")
LINES = ("evedrop: interrupted", "evedrop: go on with", "evedrop: warning", "^C")

Moment = Callable[[Live], object]


def heeds(pid: int) -> bool:
    """Whether a process has its handlers for SIGHUP and SIGTERM in place."""
    return catches(pid, signal.SIGHUP) and catches(pid, signal.SIGTERM)


def has_loaded(pid: int, library: str) -> bool:
    """Whether a process has come to import a library."""
    with contextlib.suppress(OSError):
        return library in Path(f"/proc/{pid}/maps").read_text()
    return False


MOMENTS: dict[str, Moment] = {
    "first": lambda live: heeds(live.process.pid),
    "import": lambda live: has_loaded(live.process.pid, "_multiarray_umath"),
    "folder": lambda live: live.folder.exists(),
    "child": lambda live: live.children(),
    "done": lambda live: live.done() > 0,
    "disk": lambda live: last_round(live.folder).slots > 0,
    "finish": lambda live: (live.folder / UNFINISHED / "slots.parquet").exists() or (live.folder / "slots.parquet").exists(),
}  # fmt: skip

COMMANDS: dict[str, tuple[str, ...]] = {
    "run": ("run", "eavesdroppers", *ENDLESS, "--view", "off"),
    "short run": ("run", "eavesdroppers", "--slots", "500", "--view", "off"),
    "shards": ("run", "eavesdroppers", *ENDLESS, "--trials", "4", "--set", "shards=2", "--view", "off"),
    "montecarlo": ("montecarlo", "eavesdroppers", "--trials", "100000", "--slots", "1000", "--workers", "1"),
    "workers": ("montecarlo", "eavesdroppers", "--trials", "100000", "--slots", "1000", "--workers", "2"),
    "sweep": ("sweep", "eavesdroppers", "--over", "slots=100:4000:1", "--trials", "100", "--workers", "1"),
    "compare": ("compare", "eavesdroppers", "--trials", "5000", "--slots", "500", "--workers", "1"),
    "test": ("test", "eavesdroppers", "vehicle", "--in-memory", "--trials", "20000"),
}
QUICK = (
    ("run", "first", signal.SIGTERM),
    ("run", "import", signal.SIGHUP),
    ("short run", "finish", signal.SIGINT),
    ("montecarlo", "import", signal.SIGTERM),
    ("workers", "done", signal.SIGHUP),
    ("test", "import", signal.SIGINT),
)
REST = [
    (command, moment, number)
    for command in COMMANDS
    for moment in MOMENTS
    for number in SIGNALS
    if (command, moment, number) not in QUICK
    and (moment != "finish" or command == "short run")
    and (moment not in {"child", "disk"} or command in {"run", "short run"})
    and (moment not in {"folder", "done"} or command != "test")  # it has neither results nor a progress line
]


def interrupted(live: Live, done: Done) -> None:
    """Check how a command ended that was sent a signal."""
    assert done.status == 130, (done.status, done.err)
    assert "Traceback" not in done.err + done.out
    assert all(line.startswith(LINES) for line in done.err.splitlines()), done.err
    live.nothing_left()
    if (live.folder / "summary.json").exists() or (live.folder / UNFINISHED).exists():
        results = Results.read(live.folder)
        assert results.slots.num_rows >= 0
        assert results.digests.num_rows >= 0


@pytest.mark.parametrize(
    ("command", "moment", "number"),
    [*QUICK, *(pytest.param(*case, marks=pytest.mark.long) for case in REST)],
    ids=lambda part: part.name if isinstance(part, signal.Signals) else part,
)
def test_a_signal_ends_a_command_in_order(evedrop: Evedrop, command: str, moment: str, number: signal.Signals) -> None:
    """All three the same, from the first moment on that Python lets us decide, to the last file."""
    if moment in {"first", "import"}:  # a fork has made the imports, and need not wait for them
        live = evedrop.begun(*COMMANDS[command], "--out", "run")
        live.folder = evedrop.folder / "run"
    else:
        live = evedrop.started(*COMMANDS[command])
    wait_until(lambda: MOMENTS[moment](live) or live.process.poll() is not None, moment)
    if live.process.poll() is None:
        live.process.send_signal(number)
    done = live.end()
    if command == "short run" and moment in {"done", "disk", "finish"} and done.status in {0, 1}:  # it had ended before
        assert live.results.summary["ended"] == "complete"
        return
    interrupted(live, done)


@pytest.mark.parametrize("command", mostly_long(["run", "shards", "montecarlo"], ["shards", "montecarlo"]))
def test_a_command_that_is_killed_in_its_first_moments_can_be_repeated(evedrop: Evedrop, command: str) -> None:
    """The scenario is in the folder before any process is started and any trial is computed."""
    live = evedrop.started(*COMMANDS[command])
    began = live.children if command != "montecarlo" else live.done
    wait_until(lambda: began() or live.process.poll() is not None, "a beginning")
    live.process.kill()
    live.process.wait()
    again = evedrop("montecarlo", "run", "--slots", "20", "--trials", "2", "--out", "again")
    assert (again.status, again.err) == (0, "")


@pytest.mark.long
def test_a_folder_that_is_still_empty_is_removed(evedrop: Evedrop) -> None:
    """A command that is interrupted while it still checks its scenarios leaves nothing."""
    live = evedrop.begun(*COMMANDS["sweep"])
    runs = evedrop.folder / "runs"
    wait_until(lambda: [*runs.glob("*")] or live.process.poll() is not None, "a folder")
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    assert not runs.exists()


@pytest.mark.long
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
@pytest.mark.parametrize("command", ["short run", "montecarlo", "sweep"])
def test_a_signal_may_come_at_any_time(evedrop: Evedrop, command: str, number: signal.Signals) -> None:
    """After 0, 1, 2, … fortieths of the time that a run takes."""
    begun = time.monotonic()
    live = evedrop.started(*COMMANDS["short run"], out="first")
    assert live.end().status in {0, 1}
    takes = time.monotonic() - begun
    for part in range(40):
        live = evedrop.started(*COMMANDS[command], out=f"{command.rsplit(maxsplit=1)[-1]}-{part}")
        wait_until(partial(heeds, live.process.pid), "handlers")
        with contextlib.suppress(subprocess.TimeoutExpired):
            live.process.wait(takes * part / 40)
        live.process.send_signal(number)
        done = live.end()
        if done.status in {0, 1}:
            assert live.results.summary["ended"] == "complete"
        else:
            interrupted(live, done)


@pytest.mark.long
def test_a_second_signal_changes_nothing(evedrop: Evedrop) -> None:
    """An impatient user, or a system that shuts down, sends another while the first is heeded."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    live.process.send_signal(signal.SIGINT)
    while live.process.poll() is None:
        live.process.send_signal(signal.SIGINT)
        live.process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            live.process.wait(0.05)
    done = live.end()
    assert done.status == 130
    assert "Traceback" not in done.err
    live.nothing_left()
    assert live.results.slots.num_rows == 4 * live.results.summary["slots"] > 0


@pytest.mark.long
@pytest.mark.parametrize("first", ["command", "children"])
def test_a_hang_up_of_everybody_is_one_of_the_run(evedrop: Evedrop, first: str) -> None:
    """Every process of a run gets it, in whatever order: 130, and the results are written."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    children = [*live.children().values()]
    for pid in [live.process.pid, *children] if first == "command" else [*children, live.process.pid]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGHUP)
    interrupted(live, live.end())
    assert live.results.summary["ended"] == "interrupted"
    assert live.results.slots.num_rows == 4 * live.results.summary["slots"] > 0


IN_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, "-m", "evedrop", *sys.argv[1:]])
"""
"""The command, as what a terminal was opened for."""


@pytest.mark.long
def test_a_terminal_that_closes_ends_the_run(evedrop: Evedrop) -> None:
    """The terminal hangs up, and the output goes nowhere: the status is still 130, and the results are whole."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", IN_TERMINAL, "run", "eavesdroppers", *ENDLESS, "--view", "off", "--out", "run"],
        cwd=evedrop.folder, stdin=theirs, stdout=theirs, stderr=theirs, env={**evedrop.environment, "TERM": "xterm"},
        start_new_session=True, text=True,
    )  # fmt: skip
    os.close(theirs)
    live = Live(process, evedrop.temporary, evedrop.folder / "run")
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    os.close(ours)
    wait_until(lambda: process.poll() is not None, "an end")
    assert process.returncode == 130
    live.nothing_left()
    assert live.results.summary["ended"] == "interrupted"
    assert live.results.slots.num_rows == 4 * live.results.summary["slots"] > 0


@pytest.mark.long
def test_nohup_keeps_a_run_from_hanging_up(evedrop: Evedrop) -> None:
    """A signal that was ignored when the command was started stays ignored, in all its processes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        live = evedrop.live("eavesdroppers", "--slots", "300", "--paused", interpreter=True)
    finally:
        signal.signal(signal.SIGHUP, before)
    live.held()
    for pid in (live.process.pid, *live.children().values()):
        os.kill(pid, signal.SIGHUP)
    assert evedrop("resume", str(live.folder)).status == 0
    done = live.end()
    assert done.status == 0, done.err
    assert live.results.summary["slots"] == 300


@pytest.mark.long
@pytest.mark.parametrize("number", SIGNALS)
def test_a_process_by_hand_ends_with_130_too(tmp_path: Path, number: signal.Signals) -> None:
    """A receiver, the sensor and the router at once, and the recorder with its results, whatever they wait for."""
    with by_hand(load("eavesdroppers", {"slots": 1_000_000}), tmp_path, f"tcp/127.0.0.1:{free_port()}") as run:
        run.write()
        run.start()
        wait_until(lambda: last_round(run.folder / "run").slots > 0, "slots on disk")
        run.processes["recorder"].send_signal(number)
        assert run.processes["recorder"].wait(LIMIT) == 130
        results = Results.read(run.folder / "run")
        assert results.summary["ended"] == "interrupted"
        assert results.slots.num_rows == 4 * results.summary["slots"] > 0
    (tmp_path / "second").mkdir()
    with by_hand(load("eavesdroppers"), tmp_path / "second", f"tcp/127.0.0.1:{free_port()}") as run:
        run.write()
        run.start("router", "sensor", "smart")  # which wait for the others
        for name in ("smart", "sensor", "router"):
            wait_until(partial(heeds, run.processes[name].pid), f"{name} with handlers")
            run.processes[name].send_signal(number)
            assert run.processes[name].wait(LIMIT) == 130


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_until_a_process_of_a_run_heeds_it(evedrop: Evedrop, number: signal.Signals) -> None:
    """Sent as soon as it is forked, before any line of ours: it ends with 130, without a traceback, and is named."""
    begin = (
        "import os, sys\n"
        "def forked():\n"
        "    if 'evedrop.live.recorder.recorder' in sys.modules:\n"
        "        os.kill(os.getpid(), NUMBER)\n"
        "os.register_at_fork(after_in_child=forked)\n"
    )
    (evedrop.folder / "sitecustomize.py").write_text(begin.replace("NUMBER", str(int(number))))
    environment = {**evedrop.environment, "PYTHONPATH": str(evedrop.folder)}
    live = evedrop.live("eavesdroppers", *ENDLESS, env=environment, interpreter=True)
    done = live.end()
    assert done.status == 3
    assert done.err.startswith("evedrop: recorder was interrupted by a signal")
    assert "Traceback" not in done.err
    live.nothing_left()


IN_THE_REPORT = """
import argparse, os, signal, sys
from pathlib import Path
from evedrop.cli import options, report
from evedrop.errors import RunError
from evedrop.system.signals import heed_signals
heed_signals()
report.print_results = lambda *_: os.kill(os.getpid(), signal.SIGINT)
failure = RunError("smart stopped responding") if sys.argv[1] == "3" else None
options.print_so_far(Path("run"), argparse.Namespace(json=False, verbose=False), int(sys.argv[1]), failure)
"""
"""A report during which a signal comes."""


@pytest.mark.parametrize(("status", "said"), [(0, ""), (1, ""), (3, "evedrop: smart stopped responding\n")])
def test_a_signal_while_the_report_is_printed_does_not_change_how_the_run_has_ended(status: int, said: str) -> None:
    """The status is that of the run, and a failure is said."""
    command = [sys.executable, "-c", IN_THE_REPORT, str(status)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT)
    assert (done.returncode, done.stderr) == (status, said)
