"""A results folder whose writer is killed, or whose disk fails, at any operation: its rows are right, and whole up to a round.

The disk is a simulated one, so that every operation of the writer is disturbed once in each way.
"""

from __future__ import annotations

import errno
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import accumulate
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from evedrop.errors import UsageError
from evedrop.model.process import Floats
from evedrop.results.crash_proof_tables import TableRound, is_unfinished
from evedrop.results.ending import note_end
from evedrop.results.folder import UNFINISHED, make_private
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import write_resolved
from evedrop.results.summary_file import write_summary
from evedrop.results.writer import ResultsWriter
from evedrop.scenario.loading import load
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import RunOutcome, summary_of
from evedrop.score.summary import Summary
from evedrop.score.sums import SlotSums
from evedrop.system.files import lines_in
from evedrop.system.world import world
from evedrop.virtual.disk import DiskFault, DiskFaults
from tests.disks import at, run_program, simulated
from tests.examples import examples, mostly_long

PAGE = 4096
ROUNDS = (40, 1500, 60)
"""The slots of each round. A column of the second one takes some pages."""
ROUND_ENDS = [*accumulate(ROUNDS)]
SLOTS = ROUND_ENDS[-1]


@cache
def scenario() -> Scenario:
    """A scenario with several receivers."""
    return load("eavesdroppers", {"slots": SLOTS, "expect": []})


@cache
def metrics(slots: int) -> Summary:
    """A summary of nothing."""
    nothing = RunTally.nothing(scenario(), 1)
    summary = summary_of(scenario(), nothing, dict.fromkeys(scenario().digested), RunOutcome(0.0, "complete"))
    return replace(summary, slots=slots)


@cache
def numbers(receiver: str) -> Floats:
    """What is measured of a receiver, (slots,): numbers that cannot be compressed, so that a lost page changes them."""
    return np.random.default_rng(scenario().receivers.index(receiver)).random(SLOTS) + 1.0


def record(folder: Path, whole: list[int]) -> None:
    """Write the results of a run. whole: gets the number of slots of each round that is written."""
    make_private(folder)
    write_resolved(folder, scenario())
    with ResultsWriter(folder, scenario()) as writer:
        whole.append(0)
        first = 0
        for count in ROUNDS:
            for receiver in scenario().receivers:
                values = numbers(receiver)[first : first + count]
                one = np.ones(count)
                sums = SlotSums(one, values, values**2, values, values**2, one, one)
                writer.slot_rows(first, receiver, sums, values)
            first += count
            if first == ROUNDS[0]:
                writer.settle(f"slot {first}", metrics(first))
            else:
                writer.write_rows(f"slot {first}")
            whole.append(first)
            world().sleep(3.0)
    write_summary(folder, metrics(SLOTS))


def slots_of(table: pa.Table) -> int:
    """How many slots a table has, after a check that all of its numbers are right."""
    counts = set()
    for receiver in scenario().receivers:
        rows = table.filter(pc.equal(table["peer"].cast(pa.string()), receiver))
        counts.add(len(rows))
        assert rows["slot"].to_pylist() == [*range(len(rows))]
        assert np.array_equal(rows["theoretical_trace_covariance"].to_numpy(), numbers(receiver)[: len(rows)])
        assert np.array_equal(rows["mean_squared_error"].to_numpy(), numbers(receiver)[: len(rows)])
    (slots,) = counts
    return slots


def disturbed(folder: Path, faults: DiskFaults, seed: int = 1) -> tuple[Path, list[int], int]:
    """The results folder of a run in which something went wrong; the rounds that were written; the number of operations."""
    whole: list[int] = []
    folder.mkdir()
    with simulated(folder, seed, faults) as (scheduler, disk):
        with suppress(OSError):
            run_program(scheduler, lambda: record(disk.root / "run", whole))
        return disk.root / "run", whole, disk.operations


def each_operation(folder: Path) -> range:
    """The operations of a run, after a check that all rows are there if none is disturbed."""
    place, whole, operations = disturbed(folder / "undisturbed", lambda _: None)
    assert whole == [0, *ROUND_ENDS]
    assert Results.read(place).summary["ended"] == "complete"
    assert slots_of(Results.read(place).slots) == SLOTS
    return range(1, operations + 1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "fault", mostly_long([one for one in DiskFault if one is not DiskFault.POWER_CUT], [DiskFault.KILL, DiskFault.FULL])
)
def test_all_rounds_that_were_written_are_read(fault: DiskFault, tmp_path: Path) -> None:
    """Also by the launcher, which then completes the folder."""
    for number in each_operation(tmp_path):
        folder, whole, _ = disturbed(tmp_path / str(number), at(number, fault))
        if not any(whole):  # there is nothing to read, or the first round
            continue
        slots = slots_of(Results.read(folder).slots)
        assert slots in ROUND_ENDS
        assert slots >= whole[-1]
        if is_unfinished(folder):
            note_end(folder, scenario(), "recorder was ended by signal 9")
            assert slots_of(Results.read(folder).slots) == slots
            assert not is_unfinished(folder)


@pytest.mark.thorough
def test_a_power_cut_leaves_right_rows_up_to_a_round(tmp_path: Path) -> None:
    """Or a folder of which a line says what it lacks."""
    ends = Counter[int]()
    for number in each_operation(tmp_path):
        for seed in range(examples(8)):
            folder, _, _ = disturbed(tmp_path / f"{number}-{seed}", at(number, DiskFault.POWER_CUT), seed)
            with suppress(UsageError):
                ends[slots_of(Results.read(folder).slots)] += 1
    assert {*ends} <= {0, *ROUND_ENDS}
    assert ends[SLOTS] > len(ROUNDS)


def test_a_round_of_which_a_page_is_lost_does_not_count(tmp_path: Path) -> None:
    """Though the numbers in it could be read: they would be others."""
    with simulated(tmp_path) as (scheduler, disk):
        whole_rounds: list[int] = []
        thread = scheduler.thread("main", lambda: record(disk.root / "run", whole_rounds), scheduler.process("program"))
        thread.start()
        scheduler.run(60.0, lambda: len(whole_rounds) == 3)
        scheduler.end(thread.task, -9)
        folder = disk.root / "run"
    stream = folder / UNFINISHED / "slots-0.arrows"
    whole = stream.read_bytes()
    assert slots_of(Results.read(folder).slots) == ROUND_ENDS[1]
    (first, _), (last, _) = (
        TableRound.read(line).checks["slots"] for line in lines_in(folder / UNFINISHED / "rounds")[1:]
    )
    for page in range(first // PAGE + 1, last // PAGE):
        stream.write_bytes(whole[: page * PAGE] + bytes(PAGE) + whole[(page + 1) * PAGE :])
        assert slots_of(Results.read(folder).slots) == ROUND_ENDS[0]


def test_a_power_cut_after_the_end_takes_nothing(tmp_path: Path) -> None:
    """Nor the summary: the run is as complete as its writer said."""
    for seed in range(examples(20)):
        (tmp_path / str(seed)).mkdir()
        with simulated(tmp_path / str(seed), seed) as (scheduler, disk):
            run_program(scheduler, partial(record, disk.root / "run", []))
            disk.power_cut()
            results = Results.read(disk.root / "run")
            assert slots_of(results.slots) == SLOTS
            assert results.summary["ended"] == "complete"


def test_a_summary_whose_name_cannot_be_synced_is_there_all_the_same(tmp_path: Path) -> None:
    """The run is complete."""
    with simulated(tmp_path) as (scheduler, disk):
        folder = disk.root / "run"
        run_program(scheduler, partial(record, folder, []))
        syncs: list[Path] = []

        def fails() -> None:
            honest = disk.sync

            def sync(path: Path) -> None:
                syncs.append(path)
                if path.name == "summary.json":
                    raise OSError(errno.EIO, "Input/output error")
                honest(path)

            with patch.object(type(disk), "sync", lambda _, path: sync(path)):
                write_summary(folder, metrics(SLOTS))

        run_program(scheduler, fails)
        assert folder / "summary.json" in syncs
        assert Results.read(folder).summary["ended"] == "complete"
