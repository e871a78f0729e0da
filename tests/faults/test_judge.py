"""The judge of the campaign sees what it looks for, in runs that are complete and in runs that ended early."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from evedrop.results.reading import Results
from evedrop.virtual.metrics import unlike_digests, unlike_memory, unlike_rows
from evedrop.virtual.reference import RunReference, tables_of
from evedrop.virtual.results import missing_rows
from tests.conftest import wait_until
from tests.examples import mostly_long
from tests.faults import ours
from tests.faults.disturbed import CONFUSED_FILE
from tests.faults.ended import Ended
from tests.faults.kinds import CONFUSED, EVERYBODY, Fault
from tests.faults.moments import Moment
from tests.faults.outages import unexplained_outages
from tests.faults.variants import VARIANTS

KILL = Fault("kill", "smart", Moment("run", 0.5))
ROUTER = Fault("kill", "router", Moment("run", 0.5))
INTERRUPT = Fault("interrupt", "launcher", Moment("run", 0.5))
FLAP = Fault("flap", "smart", Moment("run", 0.5), seconds=1.0, count=3)


def test_wrong_rows_are_seen(reference: RunReference, memory: Path) -> None:
    """A number that is off in its last bit, a row that is another's, one that is there twice; and no other."""
    tables = dict(tables_of(Results.read(memory), journal=False))
    assert [line for name, table in tables.items() for line in reference.wrong_rows(name, table)] == []
    rows = tables["trials"].slice(100, 3).to_pylist()
    rows[0]["squared_error"] = math.nextafter(rows[0]["squared_error"], math.inf)
    rows[1]["peer"] = "smart" if rows[1]["peer"] != "smart" else "naive"
    wrong = pa.Table.from_pylist([*rows, rows[2]], schema=tables["trials"].schema.remove_metadata())
    misses = list(reference.wrong_rows("trials", wrong))
    assert len(misses) == 3
    assert "squared_error is" in misses[0]
    assert "twice" in misses[2]


def test_another_summary_is_seen(reference: RunReference) -> None:
    """Another digest, another account of a link, a slot that is missing, an entry that memory does not have."""
    summary: dict[str, Any] = {
        **reference.summary,
        "slots": 1,
        "peers": {name: {**peer, "digest": "00"} for name, peer in reference.summary["peers"].items()},
        "links": {name: {**link, "delivered": 0} for name, link in reference.summary["links"].items()},
        "more": 1,
    }
    assert list(unlike_memory(reference.summary, reference.summary)) == []
    assert len(list(unlike_memory(summary, reference.summary))) == 2 + 2 * len(VARIANTS["plain"].receivers)


STATUSES: dict[str, tuple[int, str, list[Fault], str]] = {
    "a status that nothing explains": (3, "evedrop: smart left", [FLAP], "although nothing of this may end a run"),
    "somebody else blamed": (3, "evedrop: naive was ended by signal 9", [KILL], "names none of smart"),
    "a status that is none": (1, "", [KILL], "status 1"),
    "an interrupt out of nothing": (130, "evedrop: interrupted", [KILL], "no signal asked for the end"),
    "a traceback": (0, "Traceback (most recent call last):\n  boom", [], "has a traceback"),
}


@pytest.mark.parametrize("case", STATUSES)
def test_the_judge_sees(case: str, ended: Ended, reference: RunReference) -> None:
    """What a launcher must not do or say."""
    ended.launcher.returncode, stderr, hits, expected = STATUSES[case]
    (ended.folder / "stderr").write_text(stderr)
    misses = ended.misses(reference, *hits)
    assert [line for line in misses if expected in line], misses


def without(*places: int) -> Callable[[pa.Table], pa.Table]:
    """A table without some rows; negative places count from its end."""

    def change(table: pa.Table) -> pa.Table:
        gone = {place % table.num_rows for place in places}
        return table.take([row for row in range(table.num_rows) if row not in gone])

    return change


def without_slot(slot: int) -> Callable[[pa.Table], pa.Table]:
    """A table without the rows of a slot."""
    return lambda table: table.filter(pc.not_equal(table["slot"], slot))


def half(table: pa.Table) -> pa.Table:
    """The first half of a table."""
    return table.slice(0, table.num_rows // 2)


LACKING = {
    "one slot of the journal": ("journal", without_slot(20)),
    "one slot of the trials": ("trials", without_slot(20)),
    "one slot of the slots": ("slots", without_slot(20)),
    "the last row of the journal": ("journal", without(-1)),
    "the last row of the trials": ("trials", without(-1)),
    "half of the trials": ("trials", half),
    "half of the journal": ("journal", half),
}
"""What was missing in runs that ended early without being noticed."""


def test_the_judge_has_nothing_to_say_of_runs_that_are_whole(ended: Ended, reference: RunReference) -> None:
    """A complete one."""
    assert ended.misses(reference) == []


def test_the_judge_has_nothing_to_say_of_early_ends_that_are_whole(early: Ended, reference: RunReference) -> None:
    """One that ended early, for which a fault is to blame."""
    assert early.misses(reference, KILL) == []


@pytest.mark.parametrize(
    "case", mostly_long(LACKING, ["one slot of the journal", "the last row of the trials", "one slot of the slots"])
)
def test_missing_rows_of_a_run_that_ended_early_are_seen(case: str, early: Ended, reference: RunReference) -> None:
    """All tables are counted up to the slot of the summary."""
    name, change = LACKING[case]
    early.change(name, change)
    misses = early.misses(reference, KILL)
    assert [line for line in misses if line.startswith(f"{name} lacks")], misses


def test_a_closed_loop_needs_inputs_from_its_first_slot_on(memory: Path, reference: RunReference) -> None:
    """A run that ended before has no account of its controller."""
    loop = replace(reference, tables={**reference.tables, "inputs": {(0, 0): {}}})
    results = Results.read(memory)
    tables = {name: table.slice(0, 0) for name, table in tables_of(results)}
    tables["journal"] = results.journal.slice(0, 0)

    def missing(slots: int) -> list[str]:
        return list(missing_rows(tables, {"slots": slots, "first_trial": 0, "trials": 1}, loop, complete=False))

    assert missing(0) == []
    assert "there is no table inputs" in missing(1)


def test_missing_digests_are_seen(ended: Ended, reference: RunReference) -> None:
    """Each block that has ended has one, for each receiver and trial."""
    ended.change("digests", without(-1))
    assert [line for line in ended.misses(reference) if line.startswith("digests lacks 1 of 8 rows")]


@pytest.mark.parametrize(
    ("when", "metric"),
    mostly_long(
        [
            (when, metric)
            for when in ("ended", "early")
            for metric in ("mean_squared_error", "mean_trace_covariance", "received_fraction")
        ],
        [("ended", "mean_trace_covariance"), ("early", "mean_squared_error")],
    ),
)
def test_swapped_metrics_are_seen(
    when: str, metric: str, request: pytest.FixtureRequest, reference: RunReference
) -> None:
    """Metrics of two receivers exchanged in the summary, of a complete run and of one that ended early."""
    run: Ended = request.getfixturevalue(when)

    def swap(summary: dict[str, Any]) -> None:
        a, b = summary["peers"]["smart"], summary["peers"]["naive"]
        a[metric], b[metric] = b[metric], a[metric] + 1e-3

    run.edit(swap)
    misses = run.misses(reference, *([KILL] if when == "early" else []))
    assert [line for line in misses if line.startswith(f"{metric} of smart is")], misses


def test_another_account_of_a_run_that_ended_early_is_seen(early: Ended, reference: RunReference) -> None:
    """A loss of another reason, and one that is not counted."""
    early.edit(lambda summary: summary["links"]["smart"].update(lost_by={"cut": summary["links"]["smart"]["lost"]}))
    early.edit(lambda summary: summary["links"]["naive"].update(lost=0))
    misses = early.misses(reference, KILL)
    assert [line for line in misses if "losses of smart's link" in line], misses
    assert [line for line in misses if "account of naive's link does not add up" in line], misses


def progress(done: int, at: float) -> dict[str, Any]:
    """Events of the progress of a run."""
    return {"event": "progress", "done": done, "at": at}


@pytest.mark.thorough
def test_an_outage_that_is_not_listed_is_seen(ended: Ended, reference: RunReference) -> None:
    """A router was killed at 1.0 s and slots came afterwards; and one that the run told of."""
    ended.told = [progress(100, 0.9), progress(200, 2.0)]
    assert [line for line in ended.misses(reference, ROUTER) if "the summary lists no outage" in line]
    ended.told = [progress(399, 0.9)]  # it may have been over already
    assert ended.misses(reference, ROUTER) == []
    ended.told = [{"event": "started", "at": 1.5}, progress(200, 2.0)]  # it had not begun
    assert ended.misses(reference, ROUTER) == []
    ended.told = [{"event": "reconnected", "process": "router", "slot": 7, "at": 2.0}]
    assert [line for line in ended.misses(reference, ROUTER) if "told of an outage of router at slot 7" in line]


def test_metrics_without_rows_are_seen(ended: Ended, reference: RunReference) -> None:
    """Of a receiver that is in the summary and in no row of the journal."""
    table = pq.read_table(ended.out / "journal.parquet")
    pq.write_table(table.filter(pc.field("link") != "smart"), ended.out / "journal.parquet")
    assert [line for line in ended.misses(reference) if "the tables have no rows of smart" in line]


@pytest.mark.thorough
def test_an_outage_without_a_cause_is_seen(ended: Ended, reference: RunReference) -> None:
    """Of a process that nobody cut off; of one that a fault did, it may be listed."""
    outage = {"process": "smart", "slot": 3, "until": 9, "seconds": 1.0}
    ended.edit(lambda summary: summary["outages"].append(outage))
    assert [line for line in ended.misses(reference) if "no fault caused one" in line]
    assert ended.misses(reference, FLAP) == []


def test_the_judge_sees_what_is_left_and_what_cannot_be_read(ended: Ended, reference: RunReference) -> None:
    """A private folder, and a table that is cut off."""
    (ended.temporaries[""] / "evedrop-x").mkdir()
    whole = (ended.out / "slots.parquet").read_bytes()
    (ended.out / "slots.parquet").write_bytes(whole[: len(whole) // 2])
    lines = ended.misses(reference)
    assert [line for line in lines if "evedrop-x is left" in line]
    assert [line for line in lines if "slots.parquet cannot be read" in line]


def test_a_launcher_that_heeds_no_signal_is_seen(ended: Ended, reference: RunReference) -> None:
    """Slots are done a second after the signal, and all of them at the end; events of the end alone say nothing."""
    ended.told = [progress(399, 2.5), progress(400, 2.6)]
    assert [line for line in ended.misses(reference, INTERRUPT) if "the run went on to its end" in line]
    ended.told = [progress(399, 1.5), progress(400, 2.6)]
    assert ended.misses(reference, INTERRUPT) == []


def test_files_that_others_may_read_and_files_of_a_run_that_goes_on_are_seen(
    ended: Ended, reference: RunReference
) -> None:
    """The results have the seed and the truth; a control file has a password."""
    (ended.out / "control.json").touch(mode=0o644)
    misses = ended.misses(reference)
    assert [line for line in misses if "others may use run/control.json, whose mode is 644" in line], misses
    assert [line for line in misses if "run/control.json is left of the run" in line], misses


@pytest.mark.thorough
def test_messages_on_wrong_keys_must_be_listed(ended: Ended, reference: RunReference) -> None:
    """A router has confused keys, and no process says that it dropped a message; one of few messages confuses none."""
    confused = Fault(CONFUSED, EVERYBODY, Moment("start", 0.0), count=30)
    assert ended.misses(reference, confused) == []
    (ended.folder / CONFUSED_FILE).touch()
    assert [line for line in ended.misses(reference, confused) if "keys that they do not name" in line]
    ended.edit(lambda summary: summary.update(misdelivered={"smart": 5}))
    assert ended.misses(reference, confused) == []


@pytest.mark.parametrize("complete", [True, False])
def test_an_outage_is_explained_by_a_fault_that_can_cause_it(complete: bool) -> None:
    """Whose own connection flaps sees all others go; the end of a host's connection ends what runs there."""

    def unexplained(process: str, target: str) -> list[str]:
        listed = [{"process": process, "slot": 5, "until": 9, "seconds": 0.1}]
        flap = Fault("flap", target, Moment("run", 0.5), seconds=1.0, count=3)
        return list(unexplained_outages(listed, [], {flap: 1.0}, 400, complete))

    assert unexplained("naive", "recorder") == unexplained("naive", "naive") == unexplained("router", "naive") == []
    assert unexplained("naive", "smart")
    assert bool(unexplained("relay", "connection of beta")) == complete


@pytest.mark.thorough
def test_a_panic_of_zenoh_is_no_mistake_where_threads_are_few(ended: Ended, reference: RunReference) -> None:
    """Its own report cannot be helped; anywhere else it is one."""
    log = ended.out / "logs" / "smart.log"
    log.parent.mkdir(exist_ok=True, mode=0o700)
    log.write_text("thread '<unnamed>' (1) panicked at worker.rs:514:13:\nOS can't spawn worker thread\n")
    log.chmod(0o600)
    few = Fault("few processes", EVERYBODY, Moment("start", 0.0), count=30)
    assert not [line for line in ended.misses(reference, few) if "traceback" in line]
    assert [line for line in ended.misses(reference, KILL) if "smart.log has a traceback" in line]


@pytest.mark.thorough
def test_a_launcher_may_be_ended_by_the_c_library_where_memory_is_short(ended: Ended, reference: RunReference) -> None:
    """It counts as killed: no process may be left, and what was measured must be there. Elsewhere it is a mistake."""
    ended.launcher.returncode = 127
    short = Fault("little memory", "launcher", Moment("start", 0.0), count=490)
    assert [line for line in ended.misses(reference, short) if "status 127" in line]
    (ended.folder / "stderr").write_text("cannot allocate memory for thread-local data: ABORT\n")
    assert not [line for line in ended.misses(reference, short) if "status" in line or "killed" in line]
    assert [line for line in ended.misses(reference, KILL) if "killed by something else" in line]


@pytest.mark.parametrize("without", ["a row", "a receiver", "a block"])
def test_digests_that_are_not_those_of_the_rows_are_seen(without: str, ended: Ended) -> None:
    """The reference is computed by the same code, so that a mistake in the rows would be in both."""
    results = Results.read(ended.out)
    table = results.digests
    assert list(unlike_digests(results.summary, table)) == []
    last = pc.field("block") < pc.scalar(max(table["block"].to_pylist()))
    changed = {
        "a row": table.slice(1),
        "a receiver": table.filter(pc.field("peer") != "smart"),
        "a block": table.filter(last),
    }[without]
    assert list(unlike_digests(results.summary, changed))


@pytest.mark.thorough
def test_a_panic_in_zenohs_code_must_cost_nothing(ended: Ended, reference: RunReference) -> None:
    """If it ends the run, the run has not kept its promises; a panic in other code is a mistake of Evedrop's."""
    log = ended.out / "logs" / "relay.log"
    log.parent.mkdir(exist_ok=True, mode=0o700)
    log.touch(mode=0o600)

    def complaints(place: str, status: int) -> list[str]:
        log.write_text(f"thread 'rx-0' (1) panicked at {place}:491:27:\ncalled `Option::unwrap()` on a `None` value\n")
        ended.launcher.returncode = status
        return [line for line in ended.misses(reference, KILL) if "traceback" in line]

    zenohs = "checkouts/zenoh-9c599d5ef3e0480e/cc83980/zenoh/src/net/routing/dispatcher/resource.rs"
    assert complaints(zenohs, 0) == []
    assert complaints(zenohs, 3)
    assert complaints("src/kernels.rs", 0)


def test_metrics_of_shards_cover_all_rows(ended: Ended, reference: RunReference) -> None:
    """However far each shard came; unless the run says that some are of an earlier slot."""
    results = Results.read(ended.out)
    tables = dict(tables_of(results))
    summary = {**results.summary, "slots": results.summary["slots"] // 2}
    assert list(unlike_rows(summary, tables))
    assert list(unlike_rows(summary, tables, shards=2)) == []
    summary["peers"]["legitimate"]["mean_squared_error"] *= 2.0
    assert list(unlike_rows(summary, tables, shards=2))
    summary["ended"] = "killed (the metrics are as of slot 10 in shard 2; the tables have more)"
    assert list(unlike_rows(summary, tables, shards=2)) == []


def test_a_folder_that_no_command_can_show_is_seen(ended: Ended, reference: RunReference) -> None:
    """Its page cannot be written; and one that lacks a part says so."""
    (ended.out / "report.html").mkdir()
    assert [line for line in ended.misses(reference) if line.startswith("evedrop report ")]


MOVING = """
import os, sys, time
end = time.monotonic() + 600.0
open(sys.argv[1], "w").close()
while time.monotonic() < end and os.path.exists(sys.argv[1]):
    if os.fork():
        os._exit(0)
    time.sleep(0.002)
"""
"""A process that is handed to a new parent again and again."""


@pytest.fixture
def moving(tmp_path: Path) -> Iterator[Path]:
    """The folder of a process that moves from parent to parent until its file `there` is removed."""
    there = tmp_path / "there"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", MOVING, there], check=True, env=environment)
    try:
        yield tmp_path
    finally:
        there.unlink()


LOOK = """
import sys, pathlib, subprocess
from tests.faults import ours
ours.adopt_orphans()
there = pathlib.Path(sys.argv[1]) / "there"
subprocess.run([sys.executable, "-c", sys.argv[2], str(there)], check=True)
missed = sum(not ours.none_left(frozenset(), 0.0) for _ in range(8))
there.unlink()
print(missed, len(ours.none_left(frozenset(), 120.0)))
"""


@pytest.mark.long
def test_a_leftover_that_moves_to_a_new_parent_is_found(tmp_path: Path) -> None:
    """Every time, by a campaign that adopts orphans: it asks the system whether there is any child."""
    command = [sys.executable, "-c", LOOK, str(tmp_path), MOVING]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["0", "0"], done.stderr


def test_a_leftover_that_has_left_us_is_found_by_its_folder(moving: Path) -> None:
    """Its parent is the system's first process: no descendant of ours."""
    wait_until(lambda: list(ours.marked(moving)), "the process")
    assert list(ours.marked(moving / "other")) == []


def test_a_suspended_leftover_is_found(tmp_path: Path) -> None:
    """A stopped process ends only by force, and what it does is said."""
    before = frozenset(process.pid for process in ours.descendants())
    sleeping = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], env={"TMPDIR": str(tmp_path)})
    sleeping.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    left = ours.none_left(before, 0.2, tmp_path)
    assert time.monotonic() - begun >= 0.2
    assert [process.pid for process in left] == [sleeping.pid]
    sleeping.kill()
    sleeping.wait()
    assert ours.none_left(before, 0.0, tmp_path) == []
