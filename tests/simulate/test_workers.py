"""Real processes at work: interrupted, killed, out of disk, they leave a readable folder and no process."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.errors import RunError
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.simulate.tasks import OnProgress, Result, Stopped, Task
from evedrop.simulate.trials import BLOCK_TRIALS, tasks_of
from evedrop.simulate.workers import in_processes, usable_cores
from evedrop.system.world import world
from tests.conftest import LIMIT, Done, Evedrop, Live, wait_until, with_mark
from tests.processes import catches, descendants

SLOTS = 100_000
ENDLESS = ("--slots", str(SLOTS), "--trials", "1000")
SCENARIO = load("eavesdroppers", {"slots": 10})


def started(evedrop: Evedrop, workers: int) -> tuple[Live, list[int]]:
    """A study that would take minutes, under way, and its worker processes."""
    live = evedrop.started("montecarlo", "eavesdroppers", *ENDLESS, "--workers", str(workers))
    live.running()
    crew = crew_of(live)
    assert len(crew) == (workers if workers > 1 else 0)
    wait_until(lambda: all(catches(pid, signal.SIGTERM) for pid in crew), "workers that can be stopped")
    return live, crew


def crew_of(live: Live) -> list[int]:
    """Its worker processes."""
    return [pid for pid, command in with_mark(str(live.temporary)).items() if "simulate.workers import work" in command]


def no_process_left(live: Live) -> None:
    """Neither a worker nor one of Python's own."""
    wait_until(lambda: not live.left(), "no process left")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("workers", "number"),
    [(1, signal.SIGTERM), (2, signal.SIGINT)],
    ids=["SIGTERM, alone", "Ctrl-C, two"],
)
def test_interrupting_keeps_what_is_done(evedrop: Evedrop, workers: int, number: signal.Signals) -> None:
    """Exit 130, a summary that says interrupted, tables with the slots that were done, no process left."""
    live, _ = started(evedrop, workers)
    live.process.send_signal(number)
    done = live.end()
    assert done.status == 130
    assert "Traceback" not in done.err
    assert "the results so far are in " in done.err
    no_process_left(live)
    summary = live.results.summary
    assert summary["ended"] == "interrupted"
    assert 0 < summary["slots"] < SLOTS
    assert {peer["digest"] for peer in summary["peers"].values()} == {None}
    slots = live.results.slots.to_pydict()
    assert max(slots["slot"]) + 1 >= summary["slots"]
    assert min(slots["trials"]) > 0
    assert np.isfinite(slots["mean_squared_error"]).all()
    assert summary["links"]["smart"]["unexplained"] == 0


@pytest.mark.long
def test_a_ctrl_c_in_the_terminal_reaches_the_workers_too(evedrop: Evedrop) -> None:
    """The whole group gets the signal, including workers that have just started; no process prints a traceback."""
    live = evedrop.started("montecarlo", "eavesdroppers", *ENDLESS, "--workers", "2", start_new_session=True)
    wait_until(lambda: crew_of(live), "a worker")
    os.killpg(live.process.pid, signal.SIGINT)
    done = live.end()
    assert done.status == 130
    assert "Traceback" not in done.err
    no_process_left(live)


def ended_by_fault(live: Live, done: Done) -> None:
    """Exit 3, one line."""
    assert (done.status, "Traceback" in done.err, live.left()) == (3, False, {})
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: ")


@pytest.mark.thorough
def test_a_killed_worker_is_said(evedrop: Evedrop) -> None:
    """Exit 3 and one line with the signal and a remedy; no process left, and no folder that pretends to be a study."""
    live, crew = started(evedrop, 2)
    os.kill(crew[-1], signal.SIGKILL)
    done = live.end()
    no_process_left(live)
    ended_by_fault(live, done)
    assert "a worker process was ended by signal 9" in done.err
    assert "try fewer workers" in done.err
    assert not live.folder.exists()


@pytest.mark.thorough
def test_workers_end_with_who_started_them(evedrop: Evedrop) -> None:
    """After kill -9 of the command itself, the workers notice that it is gone, and end."""
    live, _ = started(evedrop, 2)
    live.process.kill()
    live.process.communicate()
    no_process_left(live)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_suspended_workers_keep_no_study_from_ending(evedrop: Evedrop, number: signal.Signals) -> None:
    """They are continued, and hand over what they have done."""
    live, crew = started(evedrop, 2)
    for pid in crew:
        os.kill(pid, signal.SIGSTOP)
    live.process.send_signal(number)
    done = live.end()
    assert done.status == 130, done.err
    no_process_left(live)
    assert live.results.summary["ended"] == "interrupted"
    assert live.results.summary["trials"] in {500, 1000}  # a machine may be so busy that one worker has not begun


@pytest.mark.long
def test_suspended_workers_do_not_outlive_a_killed_study(evedrop: Evedrop) -> None:
    """The system continues them when their parent dies; they then find their pipes closed."""
    live, crew = started(evedrop, 2)
    for pid in crew:
        os.kill(pid, signal.SIGSTOP)
    live.process.kill()
    live.process.communicate()
    no_process_left(live)


def own_crew() -> list[int]:
    """The worker processes of this one."""
    commands = {pid: Path(f"/proc/{pid}/cmdline") for pid in descendants(os.getpid())}
    return [pid for pid, command in commands.items() if b"simulate.workers import work" in command.read_bytes()]


def outcome(of: Sequence[Task[Any]], on_progress: OnProgress = lambda _: None, until_first: bool = False) -> Any:
    """What two processes make of tasks: their results, or the error that ended them. Fails the test if they do not end.

    until_first: whether they are told to stop when the first result has come.
    """
    came: list[Any] = []
    results: list[Any] = []

    def carry_out() -> None:
        try:
            results.extend(in_processes(of, 2, on_progress, lambda: until_first and bool(results)))
            came.append(results)
        except Exception as error:
            came.append(error)

    thread = threading.Thread(target=carry_out, daemon=True)
    thread.start()
    thread.join(LIMIT)
    assert came, "it did not end"
    wait_until(lambda: not own_crew(), "no worker left")
    return came[0]


@pytest.mark.long
def test_a_worker_that_stays_suspended_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its process id and its trials; one that is continued in time is not."""
    monkeypatch.setattr("evedrop.system.processes.SUSPENDED_SECONDS", 3.0)
    tasks = tasks_of(load("eavesdroppers", {"slots": SLOTS, "trials": 1000}), Mode.EXACT, 2)
    suspended: list[int] = []

    def suspend_last(_: int) -> None:
        if not suspended:
            suspended.append(own_crew()[-1])
            os.kill(suspended[0], signal.SIGSTOP)

    error = outcome(tasks, on_progress=suspend_last)
    assert isinstance(error, RunError)
    assert str(error).startswith(f"worker process {suspended[0]}, which computes trials ")
    assert "has been suspended for " in str(error)


@pytest.mark.long
def test_a_worker_that_is_continued_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """It only slows the study."""
    monkeypatch.setattr("evedrop.system.processes.SUSPENDED_SECONDS", 1000.0)
    tasks = tasks_of(load("eavesdroppers", {"slots": 2000, "trials": 1000}), Mode.EXACT, 2)
    suspended: list[int] = []

    def pause(_: int) -> None:
        if not suspended:
            suspended.append(own_crew()[-1])
            os.kill(suspended[0], signal.SIGSTOP)
            wait_until(lambda: world().is_suspended(suspended[0]), "a suspended worker")
            os.kill(suspended[0], signal.SIGCONT)

    results = outcome(tasks, on_progress=pause)
    assert sorted(number for number, _ in results) == [0, 1]
    assert all(result.complete for _, result in results)


class Hangs(Task[Result]):
    """A task whose worker writes half a message as soon as it has read it, and then does nothing for ever."""

    HALF = (
        "import os, re, sys, time\n"
        "os.write(int(re.search(r'work.(\\d+)', sys.orig_argv[-1])[1]), (1000).to_bytes(4, 'big') + b'half')\n"
        "while True: time.sleep(60)"
    )

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        """What it is read by."""
        return exec, (self.HALF,)

    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> Result:
        """Never called."""
        raise NotImplementedError

    def example(self) -> Result:
        """Never called."""
        raise NotImplementedError


@pytest.mark.long
def test_a_stop_waits_for_no_worker_that_hangs_within_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is killed; what others did is there."""
    monkeypatch.setattr("evedrop.simulate.workers._LAST_SECONDS", 0.5)
    whole = tasks_of(load("eavesdroppers", {"slots": 50, "trials": 1000}), Mode.EXACT, 2)[0]
    results = outcome([Hangs({}, 0, 1), whole], until_first=True)
    assert [number for number, _ in results] == [1]


@pytest.mark.parametrize("lack", ["process", "thread"])
def test_a_crew_of_which_one_cannot_be_started_is_ended(monkeypatch: pytest.MonkeyPatch, lack: str) -> None:
    """The second process, or its thread: none is left of those that were."""
    owner, name = (subprocess, "Popen") if lack == "process" else (threading.Thread, "start")
    begin, calls = getattr(owner, name), []

    def begin_first(*given: Any, **options: Any) -> Any:
        calls.append(given)
        if len(calls) > 1:
            raise OSError("no more") if lack == "process" else RuntimeError("can't start new thread")
        return begin(*given, **options)

    monkeypatch.setattr(owner, name, begin_first)
    with pytest.raises(RunError if lack == "process" else RuntimeError):
        next(in_processes([], 2, lambda _: None, lambda: False))
    monkeypatch.undo()
    assert own_crew() == []


@pytest.mark.long
def test_a_worker_is_given_no_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets only those variables of the command's environment that it needs to run."""
    monkeypatch.setenv("ACCESS_TOKEN", "only the command has this")
    tasks = tasks_of(load("eavesdroppers", {"slots": 2000, "trials": 1000}), Mode.EXACT, 2)
    given: list[bytes] = []

    def look(_: int) -> None:
        if not given:
            given.extend(Path(f"/proc/{pid}/environ").read_bytes() for pid in own_crew())

    assert isinstance(outcome(tasks, on_progress=look), list)
    assert given
    assert not [variable for variable in given if b"ACCESS_TOKEN" in variable]
    assert all(b"PATH=" in variable for variable in given)


def test_what_was_merged_before_a_fault_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A fault after the first batch: the tables have its trials, the summary says how the study ended."""
    from evedrop.cli.api import montecarlo
    from evedrop.simulate import montecarlo as sharing

    def failing(tasks: list[Any], *_: object) -> object:
        yield 0, tasks[0].carry_out(lambda _: None, lambda: False)
        raise RunError("a worker process died")

    monkeypatch.setattr(sharing, "in_processes", failing)
    with pytest.raises(RunError, match="died"):
        montecarlo("eavesdroppers", trials=1100, slots=20, out=tmp_path / "run", plan=Plan(workers=2))
    results = Results.read(tmp_path / "run")
    assert results.summary["ended"] == "a worker process died"
    assert set(results.slots["trials"].to_pylist()) == {1000}
    assert results.digests.num_rows == 1000 * 4


@given(st.integers(1, 40_000), st.integers(1, 9), st.integers(0, 10**9))
def test_workers_end_together(trials: int, workers: int, first: int) -> None:
    """Tasks are whole blocks, all trials once and in order; none is a block longer than another, and all have as many."""
    tasks = tasks_of(SCENARIO.model_copy(update={"trials": trials, "first_trial": first}), Mode.EXACT, workers)
    assert [task.start for task in tasks] == [first, *(task.stop for task in tasks[:-1])]
    assert tasks[-1].stop == first + trials
    blocks = [-(-(task.stop - task.start) // BLOCK_TRIALS) for task in tasks]
    assert sum(blocks) == -(-trials // BLOCK_TRIALS)
    assert max(blocks) - min(blocks) <= 1
    assert max(blocks) <= 4
    assert len(tasks) % workers == 0 or set(blocks) == {1}


def test_a_failing_worker_says_what_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error inside a worker comes back as one line with its kind."""
    scenario = load("eavesdroppers", {"slots": 10, "trials": 1500})
    tasks = tasks_of(scenario, Mode.EXACT, 2)
    broken = [replace(task, scenario={**task.scenario, "slots": "many"}) for task in tasks]
    results = in_processes(broken, 2, lambda _: None, lambda: False)
    with pytest.raises(RunError, match=r"^a worker failed: trials \d+ to \d+: ValidationError: [^\n]*slots[^\n]*$"):
        next(results)


def test_a_full_disk_is_said(evedrop: Evedrop) -> None:
    """Files can grow no further: exit 3 and one line that names the folder, no traceback."""
    study = ("montecarlo", "eavesdroppers", "--slots", "3000", "--trials", "3")
    done = evedrop.started(*study, largest_file=200_000).end()
    assert done.status == 3
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: run cannot be written (")


@pytest.mark.long
def test_an_interrupted_sweep_keeps_finished_points(evedrop: Evedrop) -> None:
    """The points that were done are in the table, the plot is drawn, exit 130."""
    points = ("--over", f"slots=20,{SLOTS}")
    live = evedrop.started("sweep", "eavesdroppers", *points, "--trials", "1000", "--workers", "2")
    live.running(more_than=20 * 1000)  # that is, when the second point is under way
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 130
    assert "interrupted; 1 of 2 points were done" in done.err
    no_process_left(live)
    table = pq.read_table(live.folder / "sweep.parquet")
    assert set(table["slots"].to_pylist()) == {20}
    assert table.num_rows == 4
    assert (live.folder / "sweep.png").is_file()


def test_the_cores_are_counted_where_the_system_cannot_say_which_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without `sched_getaffinity`, as on macOS, a large study gets all cores; without any count, one worker."""
    large = load("eavesdroppers", {"slots": SLOTS, "trials": 1000})
    assert Plan().workers_for(large) == usable_cores() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert Plan().workers_for(large) == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert Plan().workers_for(large) == 1
