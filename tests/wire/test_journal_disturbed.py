"""A wire's journal whose wire is killed, or whose disk fails, at any operation: its records are right, and none is there twice.

The disk is a simulated one, so that every operation of the wire is disturbed once in each way.
"""

from __future__ import annotations

import secrets
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from evedrop.errors import UsageError
from evedrop.virtual.disk import DiskFault, DiskFaults
from evedrop.virtual.scheduler import VirtualScheduler
from evedrop.wire.history import Numbered
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.records import Kind, WireFate
from tests.disks import at, run_program, simulated
from tests.examples import USUAL, examples, mostly_long
from tests.wire.wire_plans import wire_plan

PART_ROWS = 150
"""Records of two pages."""
ROWS = 400
"""Of each of two starts."""


@dataclass
class Wire:
    """What a wire has recorded."""

    folder: Path
    recorded: int = 0
    missing: int = 0
    """How many of these it knows to be missing on the disk."""
    told: list[str] = field(default_factory=list)
    """What it told its user."""
    ended: int = 0
    """How often it ended in order."""

    def run(self) -> None:
        """Record messages in two starts, and do from time to time what the journal's own thread does."""
        for _ in range(2):
            before = self.recorded
            with WireJournal(self.folder, wire_plan(), tell=self.told.append, part_rows=PART_ROWS) as journal:
                for n in range(before, before + ROWS):
                    key = journal.words.key_code(f"scan/{n % 7}")
                    journal.records.record(1000.0 + n, n // 7, n, 0.25, key, 0, 64, 0, Kind.PUT, WireFate.DELIVERED)
                    self.recorded += 1
                    if n % 100 == 99:
                        journal.flush()
                        with suppress(OSError):
                            journal.place.beat()
                        journal.place.poll()
                        journal.records.tend(time.time() + 1000.0 * n)
                        journal.note(f"message {n}")
            self.missing += journal.completeness.missing
            self.ended += 1


@pytest.fixture(autouse=True)
def _only_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests do the work of the journal's own thread at moments that are always the same."""
    monkeypatch.setattr("threading.Thread.start", lambda _: None)


@dataclass
class Disturbed:
    """A wire at which something has gone wrong."""

    wire: Wire
    operations: int
    scheduler: VirtualScheduler

    def start_again(self) -> dict[Numbered, int]:
        """Start the wire once more, now that nothing goes wrong; returns how many messages it had numbered."""
        counts: list[dict[Numbered, int]] = []

        def work() -> None:
            with WireJournal(self.wire.folder, wire_plan()) as journal:
                counts.append(dict(journal.counts))

        self.scheduler.errors.clear()
        run_program(self.scheduler, work)
        return counts[0]


@contextmanager
def disturbed(folder: Path, faults: DiskFaults, seed: int = 1) -> Iterator[Disturbed]:
    """A wire at which something goes wrong. Its disk stays until the block ends."""
    folder.mkdir()
    with simulated(folder, seed, faults) as (scheduler, disk):
        wire = Wire(disk.root / "wire")
        with suppress(UsageError):  # the disk was full when it started
            run_program(scheduler, wire.run)
        disk.make_room()
        disk.faults = lambda _: None
        yield Disturbed(wire, disk.operations, scheduler)
    shutil.rmtree(folder)


def messages(folder: Path) -> list[int]:
    """The messages in a journal, after a check that their rows are right."""
    rows: list[dict[str, Any]] = pa.concat_tables(journal_tables(folder)).to_pylist()
    for row in rows:
        n = row["sequence"]
        assert row["key"] in {f"scan/{n % 7}", f"unknown key {n % ROWS % 7 + 1}"}
        assert (row["time"], row["n"], row["size"], row["delay"]) == (1000.0 + n, n // 7, 64, 0.25)
        assert (row["link"], row["fate"], row["kind"]) == ("scan", "delivered", "put")
    found = [row["sequence"] for row in rows]
    assert found == sorted({*found})
    return found


def each_operation(folder: Path) -> Iterator[int]:
    """The operations of a wire, or some of them, after a check that all records are there if none is disturbed."""
    with disturbed(folder / "undisturbed", lambda _: None) as done:
        assert (done.wire.ended, done.wire.missing, done.wire.told) == (2, 0, [])
        assert messages(done.wire.folder) == [*range(2 * ROWS)]
    step = USUAL // examples(USUAL)
    yield from range(1 + secrets.randbelow(step), done.operations + 1, step)


@pytest.mark.thorough
def test_a_killed_wire_has_recorded_everything(tmp_path: Path) -> None:
    """And its next start goes on with the numbers after it."""
    for number in each_operation(tmp_path):
        with disturbed(tmp_path / str(number), at(number, DiskFault.KILL)) as done:
            wire = done.wire
            if wire.recorded:
                assert messages(wire.folder) == [*range(wire.recorded)]
                counts = {int(key.removeprefix("scan/")): n for (_, key, _), n in done.start_again().items()}
                assert counts == {key: -(-(wire.recorded - key) // 7) for key in range(min(7, wire.recorded))}
                assert messages(wire.folder) == [*range(wire.recorded)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "fault",
    mostly_long([DiskFault.SHORT, DiskFault.FULL_ONCE, DiskFault.FULL, DiskFault.BROKEN], [DiskFault.FULL]),
)
def test_what_is_missing_is_counted(fault: DiskFault, tmp_path: Path) -> None:
    """The wire goes on, and tells so; with the records that are there, it makes up all that it recorded."""
    for number in each_operation(tmp_path):
        with disturbed(tmp_path / str(number), at(number, fault)) as done:
            wire = done.wire
            if wire.recorded:
                assert len(messages(wire.folder)) + wire.missing == wire.recorded
                assert wire.told or not wire.missing
                done.start_again()
                assert len(messages(wire.folder)) + wire.missing == wire.recorded


@pytest.mark.thorough
def test_a_power_cut_takes_records_and_changes_none(tmp_path: Path) -> None:
    """The wire can be started again, and takes nothing of what is left."""
    left = Counter[bool]()
    for number in each_operation(tmp_path):
        for seed in range(examples(8)):
            with disturbed(tmp_path / f"{number}-{seed}", at(number, DiskFault.POWER_CUT), seed) as done:
                wire = done.wire
                if (wire.folder / "journal").exists():
                    found = messages(wire.folder)
                    left[len(found) == wire.recorded] += 1
                    done.start_again()
                    assert messages(wire.folder) == found
    assert left[True]
    assert left[False]
