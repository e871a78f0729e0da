"""Measurements are on disk and can be read: after kill -9 of everything, on a full disk, in a folder that was renamed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import fields, replace
from functools import cache
from io import FileIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.cli.api.running import montecarlo
from evedrop.errors import UsageError
from evedrop.results import crash_proof_tables
from evedrop.results.crash_proof_tables import goes_on, last_round, parquet_batches
from evedrop.results.ending import note_end
from evedrop.results.folder import STATES, UNFINISHED
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import TakenStates, write_resolved
from evedrop.results.summary_file import unwritten
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.scenario.recordings.disturbance_file import recorded_states
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary
from evedrop.score.sums import SlotSums
from evedrop.show.view.scene_slots import replay
from evedrop.system.disk import write_all
from evedrop.system.files import try_lock
from evedrop.virtual.disk import DiskFault
from tests.conftest import Evedrop, Live, wait_until
from tests.disks import run_program, simulated
from tests.examples import examples, mostly_long
from tests.rogue import with_rogue
from tests.steps import stepping

ENDLESS = ("--slots", "1000000")
WAITS_FOR_OTHERS = """
import threading
from evedrop.live.recorder.conductor import Conductor
Conductor.end = lambda self, patience: threading.Event().wait()
from evedrop.results.writer import ResultsWriter
ResultsWriter.checkpoint = lambda *all: None
"""


def kill_all(live: Live) -> None:
    """Kill -9 of the command and of all its processes, at once."""
    processes: list[int] = []
    # Stopped first, so that none can notice that another one is gone, and until none is left that may start others.
    while started := [pid for pid in (live.process.pid, *live.left()) if pid not in processes]:
        processes += started
        _send(signal.SIGSTOP, started)
    _send(signal.SIGKILL, processes)
    live.process.communicate()
    wait_until(lambda: not live.left(), "no process left of the run")
    wait_until(lambda: all(map(ended, processes)), "processes that have let go of their files")


def _send(number: signal.Signals, processes: list[int]) -> None:
    for pid in processes:
        with suppress(ProcessLookupError):  # it may just have ended
            os.kill(pid, number)


def ended(pid: int) -> bool:
    """Whether a process holds nothing any more.

    A thread that ends lets go of its files before it is a zombie; the first thread may be one while others still hold them.
    """
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state in {"Z", "X"} and len(os.listdir(f"/proc/{pid}/task")) <= 1
    except OSError:
        return True


def cut_short(live: Live) -> int:
    """Check that the folder of a live run that was killed opens, and says where it ends; how many slots it has."""
    results = live.results
    slots: int = results.summary["slots"]
    assert str(results.summary["ended"]).startswith(
        f"cut short at slot {slots}, because its run was killed or its disk was full"
    )
    receivers = len(results.summary["peers"])
    for table in (results.slots, results.trials, results.journal):
        assert table.num_rows == slots * receivers
        assert set(table["slot"].to_pylist()) == set(range(slots))
    assert results.digests.num_rows >= receivers * (slots // 256 - 1)
    return slots


@pytest.mark.thorough
def test_a_run_of_which_everything_was_killed_can_be_read(evedrop: Evedrop) -> None:
    """`load_results`, `view`, `view --table` and `diff` open what there is, say that it is cut short, and where."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(lambda: last_round(live.folder).slots >= 600, "slots on disk")
    assert goes_on(live.folder)
    assert str(live.results.summary["ended"]).startswith("the run goes on, at slot ")
    kill_all(live)
    slots = cut_short(live)
    done = evedrop("view", "run", "--table")
    assert done.status == 0
    assert done.out.startswith(f"cut short at slot {slots}, because its run was killed or its disk was full")
    assert "legitimate" in done.out
    assert replay(live.folder, evedrop.folder / "again.rrd").stat().st_size > 10_000
    whole = evedrop("montecarlo", "eavesdroppers", "--trials", "1", "--slots", str(slots), "--out", "memory")
    assert whole.status in {0, 1}
    same = evedrop("diff", "run", "memory")
    assert (same.status, same.err) == (0, "")
    assert f"run: cut short at slot {slots}" in same.out
    assert "no difference in" in same.out


MOMENTS: dict[str, Callable[[Live], object]] = {
    "a folder": lambda live: live.folder.exists(),
    "streams": lambda live: (live.folder / UNFINISHED).exists(),
    "first slots": lambda live: last_round(live.folder).slots > 0,
    "metrics": lambda live: (live.folder / UNFINISHED / "summary.json").exists(),
    "parquet": lambda live: (
        (live.folder / UNFINISHED / "slots.parquet").exists() or (live.folder / "slots.parquet").exists()
    ),
    "end": lambda live: (live.folder / "summary.json").exists(),
}


@pytest.mark.parametrize("case", mostly_long(MOMENTS, ["parquet"]))
def test_a_run_may_be_killed_at_any_moment(evedrop: Evedrop, case: str) -> None:
    """From its first file to its last: the folder opens with whole tables, or says in a line why there is nothing."""
    slots = 20000 if case == "metrics" else 3000
    live = evedrop.live("eavesdroppers", "--slots", str(slots))
    wait_until(lambda: MOMENTS[case](live), case)
    kill_all(live)
    if not last_round(live.folder).at and not (live.folder / "summary.json").exists():
        assert case in {"a folder", "streams"}
        with pytest.raises(UsageError, match=r"run the scenario again|give the results folder of a run"):
            Results.read(live.folder)
        return
    results = live.results
    if results.summary["ended"] != "complete":
        cut_short(live)
    else:
        assert results.trials.num_rows == 4 * slots
    if case in {"parquet", "end"}:
        assert results.summary["slots"] == 3000
    assert evedrop("view", "run", "--table").status == 0


@pytest.mark.thorough
def test_a_folder_may_be_renamed_while_a_run_goes_on(evedrop: Evedrop) -> None:
    """All results are in it, whole, and the command says where it is."""
    live = evedrop.live("eavesdroppers", "--slots", "600", "--pace", "0.001", "--paused")
    live.held()
    with stepping(evedrop, live.folder, 500):
        wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    other = live.folder.rename(evedrop.folder / "other")
    assert evedrop("resume", str(other)).status == 0
    done = live.end()
    assert done.status == 0, done.err
    assert f"the results folder was renamed while the run went on; it is {other}" in done.err
    assert f"results: {other}" in done.out
    live.nothing_left()
    assert not live.folder.exists()
    results = Results.read(other)
    assert results.summary["ended"] == "complete"
    assert results.trials.num_rows == results.journal.num_rows == 4 * 600
    assert {path.name for path in other.iterdir()} == {
        "scenario.toml", "summary.json", "slots.parquet", "trials.parquet", "journal.parquet", "digests.parquet", "logs",
        "report.html",
    }  # fmt: skip


@pytest.mark.long
def test_a_folder_that_is_removed_is_an_error_that_says_so(evedrop: Evedrop) -> None:
    """Exit 3 with the folder and what to do, no traceback, nothing left."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    shutil.rmtree(live.folder.rename(evedrop.folder / "gone"))
    done = live.end()
    assert done.status == 3
    assert "the folder was removed while the run went on" in done.err
    assert "Traceback" not in done.err
    live.nothing_left()


ON_SMALL_DISK = """
import subprocess, sys
disk, size, *command = sys.argv[1:]
if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", disk], stderr=subprocess.DEVNULL).returncode:
    sys.exit(77)
status = subprocess.run([sys.executable, "-m", "evedrop", *command]).returncode
subprocess.run(["cp", "-r", f"{disk}/run", f"{disk}-copy"], check=True)
sys.exit(status)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("size", mostly_long(["256k", "1m"], ["256k"]))
def test_a_full_disk_ends_the_run_and_what_fitted_can_be_read(evedrop: Evedrop, size: str) -> None:
    """On a disk that is really full: a clear line, exit 3, nothing left, and the tables hold what there was room for."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root may mount a small disk")
    (evedrop.folder / "disk").mkdir()
    command = ["run", "eavesdroppers", *ENDLESS, "--view", "off", "--out", "disk/run"]
    process = subprocess.Popen(
        ["unshare", "--mount", sys.executable, "-c", ON_SMALL_DISK, "disk", size, *command],
        cwd=evedrop.folder, env=evedrop.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    live = Live(process, evedrop.temporary, evedrop.folder / "disk-copy")
    done = live.end()
    if done.status in {1, 77} and "Traceback" not in done.err:
        pytest.skip("this machine lets nobody mount")
    assert done.status == 3
    page, failure = done.err.splitlines()[:2]
    assert "report.html was not written ([Errno 28] No space left on device" in page
    assert "the results cannot be written" in failure
    assert "Traceback" not in done.err
    live.nothing_left()
    results = live.results
    slots = results.summary["slots"]
    assert slots > 0
    assert results.summary["ended"] != "complete"
    for table in (results.slots, results.trials, results.journal):
        assert table.num_rows == 4 * slots
    assert evedrop("view", "disk-copy", "--table").status == 0


def test_a_killed_study_can_be_read(evedrop: Evedrop) -> None:
    """Kill -9 of Monte Carlo: the trials that were done, with statistics, digests and the recorded one."""
    live = evedrop.started("montecarlo", "eavesdroppers", "--trials", "100000", "--slots", "400", "--workers", "1")
    wait_until(lambda: last_round(live.folder).slots > 0, "trials that count")
    kill_all(live)
    results = live.results
    trials = results.summary["trials"]
    assert trials >= 500
    assert (
        f"cut short at {trials} of 100000 trials, because its run was killed or its disk was full"
        in results.summary["ended"]
    )
    assert set(results.slots["trials"].to_pylist()) == {trials}
    assert results.slots.num_rows == results.trials.num_rows == 4 * 400
    assert results.digests.num_rows == 4 * 2 * trials
    assert f"{trials:,} trials" in evedrop("view", "run", "--table").out


class _KilledError(Exception):
    """A study is killed."""


def test_a_study_that_is_killed_before_its_first_trials_count_has_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kill -9 between the metrics and the line that makes their rows count: no trials are claimed, and no slots."""

    def kill(writer: ResultsWriter, at: str, metrics: Callable[[], Summary], _before: Callable[[], None]) -> None:
        writer.write_metrics(metrics())
        shutil.copytree(tmp_path / "out", tmp_path / "killed")
        raise _KilledError

    monkeypatch.setattr(ResultsWriter, "checkpoint", kill)
    with pytest.raises(_KilledError):
        montecarlo("eavesdroppers", trials=2 * 500, slots=20, workers=2, out=tmp_path / "out")
    with pytest.raises(UsageError, match="nothing yet"):
        Results.read(tmp_path / "killed")


@pytest.mark.long
def test_the_points_of_a_killed_sweep_are_on_disk(evedrop: Evedrop) -> None:
    """The table is there while the sweep goes on, whole at any moment."""
    over = ("--over", "encoding.state_probability=0.1:0.9:0.01", "--trials", "100", "--slots", "200", "--workers", "1")
    live = evedrop.started("sweep", "eavesdroppers", *over)
    wait_until((live.folder / "sweep.parquet").exists, "a table")
    kill_all(live)
    assert pq.read_table(live.folder / "sweep.parquet").num_rows >= 4
    assert json.loads((live.folder / "sweep.json").read_text())["scenario"] == "eavesdroppers"


@pytest.mark.long
def test_the_schemes_of_a_killed_comparison_are_on_disk(evedrop: Evedrop) -> None:
    """compare.json is there while the others are played."""
    live = evedrop.started("compare", "acknowledged", "--trials", "4000", "--slots", "97", "--workers", "1")
    wait_until(lambda: (live.folder / "compare.json").exists() or live.process.poll() is not None, "schemes")
    kill_all(live)
    assert json.loads((live.folder / "compare.json").read_text())["schemes"]


SCENARIO = load("eavesdroppers")
NAMES = SCENARIO.receivers


def sums(count: int) -> SlotSums:
    """Of this number of slots of one trial."""
    return SlotSums(*(np.ones(count) for _ in fields(SlotSums)))


@settings(max_examples=examples(40))
@given(rounds=st.lists(st.integers(1, 40), min_size=1, max_size=6), data=st.data())
def test_a_writer_may_stop_at_any_byte(rounds: list[int], data: st.DataObject) -> None:
    """Of a round that was being written when the writer ended nothing is read, and everything of those before."""
    with TemporaryDirectory() as name:
        written = Path(name, "written")
        written.mkdir()
        with ResultsWriter(written, SCENARIO) as writer:
            kept = [(0, sizes(written))]
            for count in rounds:
                first = kept[-1][0]
                for receiver in NAMES:
                    writer.slot_rows(first, receiver, sums(count), np.zeros(count))
                writer.write_rows(f"slot {first + count}")
                kept.append((first + count, sizes(written)))
            folder = shutil.copytree(written, Path(name, "stopped"))
        whole = data.draw(st.integers(0, len(rounds) - 1), label="whole rounds")
        slots, before = kept[whole]
        for file, size in kept[whole + 1][1].items():
            most = size - 1 if file == "rounds" else size
            os.truncate(folder / UNFINISHED / file, data.draw(st.integers(before[file], most), label=file))
        assert last_round(folder).slots == slots
        rows = Results(folder, {}).slots.to_pylist()
        assert [row["slot"] for row in rows if row["peer"] == "smart"] == list(range(slots))


@cache
def microgrid() -> Scenario:
    """A part of a day in a house: a scenario whose metrics are those of an application."""
    return load("microgrid", {"slots": 200, "expect": []})


@pytest.mark.thorough
def test_no_rows_are_on_disk_before_the_first_metrics(tmp_path: Path) -> None:
    """Or a run that is killed just then could not be looked at: only its own classes could make metrics of nothing."""
    scenario = microgrid()
    nothing = summary_of(
        scenario, RunTally.nothing(scenario, 1), dict.fromkeys(scenario.digested), RunOutcome(0.0, "slot 10")
    )

    def metrics() -> Summary:
        assert not last_round(tmp_path).slots
        return nothing

    write_resolved(tmp_path, scenario)
    with ResultsWriter(tmp_path, scenario) as writer:
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))

        def on_disk() -> bool:
            writer.checkpoint("slot 10", metrics)
            return last_round(tmp_path).slots == 10

        wait_until(on_disk, "rows on disk")
        assert Results.read(tmp_path).summary["ended"] == "the run goes on, at slot 10"


@pytest.mark.thorough
def test_rows_whose_first_metrics_cannot_be_written_count_at_the_end(tmp_path: Path) -> None:
    """They are whole; a shard's score, which was saved before, is of them."""
    scenario = microgrid()
    nothing = summary_of(scenario, RunTally.nothing(scenario, 1), dict.fromkeys(scenario.digested), RunOutcome(0.0, ""))

    def full() -> None:
        if sizes(tmp_path)["slots-0.arrows"] > before:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def checkpoints() -> bool:
        writer.checkpoint("slot 10", lambda: nothing)
        return False

    write_resolved(tmp_path, scenario)
    with suppress(OSError), ResultsWriter(tmp_path, scenario, full) as writer:
        before = sizes(tmp_path)["slots-0.arrows"]
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))
        wait_until(checkpoints, "no room")
    assert pq.read_table(tmp_path / "slots.parquet").num_rows == 10 * len(scenario.receivers)


@pytest.mark.long
def test_a_score_is_saved_only_with_rows(tmp_path: Path) -> None:
    """What a shard saves together with its metrics: if it is killed before, it has neither score nor rows."""
    scenario = microgrid()
    nothing = summary_of(
        scenario, RunTally.nothing(scenario, 1), dict.fromkeys(scenario.digested), RunOutcome(0.0, "slot 10")
    )
    events: list[str] = []

    def metrics() -> Summary:
        events.append("metrics")
        return nothing

    def save() -> None:
        empty = sizes(tmp_path)["slots-0.arrows"] == before
        events.append("save without rows" if empty else "save")

    write_resolved(tmp_path, scenario)
    with ResultsWriter(tmp_path, scenario, save) as writer:
        before = sizes(tmp_path)["slots-0.arrows"]
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))

        def saved() -> bool:
            writer.checkpoint("slot 10", metrics)
            return bool(events)

        wait_until(saved, "a checkpoint")
    assert events == ["metrics", "save"]


def killed(folder: Path, work: Callable[[ResultsWriter], object]) -> Path:
    """The results folder of a run whose recorder was killed after some work; folder: an empty one."""
    with simulated(folder) as (scheduler, disk):
        task = scheduler.process("recorder")

        def record() -> None:
            write_resolved(disk.root, microgrid())
            writer = ResultsWriter(disk.root, microgrid())
            work(writer)
            scheduler.end(task, -9)

        scheduler.thread("main", record, task).start()
        scheduler.run(1.0, lambda: not task.alive)
        return disk.root


def test_the_end_of_a_run_without_metrics_keeps_its_rows(tmp_path: Path) -> None:
    """The launcher notes why the run ended, and takes nothing from what was measured."""
    scenario = microgrid()

    def record(writer: ResultsWriter) -> None:
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))
        writer.write_rows("slot 10")

    folder = killed(tmp_path, record)
    note_end(folder, scenario, "recorder was ended by signal 9")
    results = Results.read(folder)
    why = "recorder was ended by signal 9 (the metrics are as of slot 0; the tables have more)"
    assert (results.summary["ended"], results.summary["slots"]) == (why, 10)
    assert results.slots.num_rows == 10 * len(scenario.receivers)
    note_end(folder, scenario, "the recorder has failed")  # as the launcher says after the recorder has noted it
    why = "the recorder has failed (the metrics are as of slot 0; the tables have more)"
    assert (Results.read(folder).summary["ended"], Results.read(folder).summary["slots"]) == (why, 10)


def test_the_end_of_a_killed_run_says_which_slot_its_metrics_are_of(tmp_path: Path) -> None:
    """They were written when fewer slots were done; an excerpt of a log follows in lines of its own."""
    scenario = microgrid()
    empty = summary_of(scenario, RunTally.nothing(scenario, 1), dict.fromkeys(scenario.digested), RunOutcome(0.0, ""))

    def record(writer: ResultsWriter) -> None:
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))
        writer.settle("slot 10", replace(empty, slots=10))
        for receiver in scenario.receivers:
            writer.slot_rows(10, receiver, sums(20), np.zeros(20))
        writer.write_rows("slot 30")

    folder = killed(tmp_path, record)
    note_end(folder, scenario, "recorder was ended by signal 9\nits log:\n    nothing")
    summary = Results.read(folder).summary
    assert summary["slots"] == 30
    assert summary["ended"].splitlines() == [
        "recorder was ended by signal 9 (the metrics are as of slot 10; the tables have more)",
        "its log:",
        "    nothing",
    ]


def test_a_recorder_that_is_killed_while_it_removes_what_is_no_longer_needed_has_told_all(tmp_path: Path) -> None:
    """Its own summary, of all rows, is there: it is not said to be of an earlier moment."""
    scenario = microgrid()
    summary = summary_of(scenario, RunTally.nothing(scenario, 1), dict.fromkeys(scenario.digested), RunOutcome(0.0, ""))

    def record(writer: ResultsWriter) -> None:
        for receiver in scenario.receivers:
            writer.slot_rows(0, receiver, sums(10), np.zeros(10))
        writer.settle("slot 10", replace(summary, slots=10))

    folder = killed(tmp_path, record)
    (folder / UNFINISHED / "summary.json").rename(folder / "summary.json")
    note_end(folder, scenario, "recorder was ended by signal 9")
    assert Results.read(folder).summary["ended"] == "recorder was ended by signal 9"


def sizes(folder: Path) -> dict[str, int]:
    """File → its size, of an unfinished results folder."""
    return {path.name: path.stat().st_size for path in (folder / UNFINISHED).iterdir()}


@pytest.mark.thorough
def test_all_rows_are_on_disk_before_the_recorder_waits_for_the_others_to_end(evedrop: Evedrop) -> None:
    """A router that is gone never confirms: a recorder that is killed while it waits has lost nothing."""
    rogue = with_rogue(evedrop, "recorder", WAITS_FOR_OTHERS)
    live = evedrop.live("eavesdroppers", "--slots", "60", "--pace", "0", env=rogue)
    wait_until(lambda: last_round(live.folder).slots == 60, "all slots on disk")
    os.kill(live.child("recorder"), signal.SIGKILL)
    done = live.end()
    assert done.status == 3, done.err
    assert live.results.slots.num_rows == 4 * 60


def test_a_broken_disk_is_not_called_full() -> None:
    """After an input/output error nobody can know what is on the disk, and room does not help."""
    message = unwritten(OSError(errno.EIO, "Input/output error"))
    assert "free some room" not in message
    assert "look at the disk" in message
    assert "free some room" in unwritten(OSError(errno.ENOSPC, "No space left on device"))


def test_reading_a_parquet_file_in_batches_keeps_one_row_group(tmp_path: Path) -> None:
    """By default pyarrow (26) reads all row groups ahead and keeps them until the file is closed."""
    path, group = tmp_path / "numbers.parquet", 65_536
    numbers = np.random.default_rng(5).random(group)
    with pq.ParquetWriter(path, pa.schema([("number", pa.float64())]), use_dictionary=False) as writer:
        for _ in range(40):
            writer.write_table(pa.table({"number": numbers}))
    before, most, rows = pa.total_allocated_bytes(), 0, 0
    for batch in parquet_batches(path, 8192, ["number"]):
        most, rows = max(most, pa.total_allocated_bytes() - before), rows + batch.num_rows
    assert rows == 40 * group
    assert most < 4 * numbers.nbytes


def test_rows_follow_no_batch_that_was_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full between two rounds, when a table is so large that it is written at once, and has room again later."""
    write, full = write_all, [False]

    def write_some(file: FileIO, data: bytes) -> None:
        if full[0]:
            file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(file, data)

    monkeypatch.setattr(crash_proof_tables, "write_all", write_some)
    with pytest.raises(OSError, match="an earlier part"), ResultsWriter(tmp_path, SCENARIO) as writer:  # noqa: PT012
        for first, count in ((0, 100), (100, 200_000)):
            full[0] = first > 0
            with pytest.raises(OSError, match="space") if full[0] else nullcontext():
                writer.slot_rows(first, NAMES[0], sums(count), np.ones(count))
            full[0] = False
            writer.write_rows(f"slot {first + count}")
    assert Results(tmp_path, {}).slots.num_rows == 100


@pytest.mark.parametrize("fault", [DiskFault.BROKEN, DiskFault.FULL, DiskFault.FULL_ONCE])
def test_states_of_which_a_part_was_written_can_be_read(fault: DiskFault, tmp_path: Path) -> None:
    """An error in the middle of a write leaves the lines before it, and nothing is written again when the file is closed."""
    process = SCENARIO.process.model_copy(update={"states": ["x", "y"]})
    with simulated(tmp_path) as (scheduler, disk):

        def take() -> None:
            taken = TakenStates(disk.root, process)
            taken.add(np.array([[0.25, 0.5], [0.75, 1.0]]))
            taken.write()
            disk.fail_next(fault)
            taken.add(np.full((2, 2), 3.25))
            with pytest.raises(OSError, match=r"Input/output|No space"):
                taken.write()
            taken.close()

        run_program(scheduler, take)
        assert recorded_states(disk.root / STATES).rows == [[0.25, 0.5], [0.75, 1.0]]


def test_a_power_cut_may_take_hundreds_of_rounds(tmp_path: Path) -> None:
    """A fast run writes many in the seconds that a power cut takes; those before are found, and each table is read once."""
    kept = 0

    def write(writer: ResultsWriter) -> None:
        nonlocal kept
        for first in range(0, 4000, 10):
            if first == 100:
                kept = sizes(writer._held.now)["slots-0.arrows"]
            writer.slot_rows(first, microgrid().receivers[0], sums(10), np.random.default_rng(first).random(10))
            writer.write_rows(f"slot {first + 10}")

    folder = killed(tmp_path, write)
    assert last_round(folder).slots == 4000
    stream = folder / UNFINISHED / "slots-0.arrows"
    whole = stream.read_bytes()
    stream.write_bytes(whole[:kept] + bytes(100) + whole[kept + 100 :])
    assert last_round(folder).slots == 100


def test_a_reader_does_not_keep_a_run_from_its_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that checks whether the run goes on holds the lock for a moment. Later readers must still see that it does."""
    lock, readers = try_lock, [True, True]
    monkeypatch.setattr(
        crash_proof_tables, "try_lock", lambda descriptor: not (readers and readers.pop()) and lock(descriptor)
    )
    with ResultsWriter(tmp_path, SCENARIO):
        assert goes_on(tmp_path)


def test_a_table_that_cannot_be_read_stays_a_stream(tmp_path: Path) -> None:
    """Its file `unfinished` has all that there is; a Parquet file would lack rows that the run counted."""
    with suppress(OSError), ResultsWriter(tmp_path, SCENARIO) as writer:
        for first in (0, 100):
            writer.slot_rows(first, NAMES[0], sums(100), np.ones(100))
            writer.write_rows(f"slot {first + 100}")
        (stream,) = (tmp_path / UNFINISHED).glob("slots-*")
        os.truncate(stream, stream.stat().st_size - 100)
    assert stream.exists()
    assert not (tmp_path / "slots.parquet").exists()
