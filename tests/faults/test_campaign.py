"""The campaign itself: some of its cases, and that it would see what it looks for."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evedrop.results.writer import JOURNAL, load_results
from tests.faults import judge, ours
from tests.faults.cases import HASTY_SECONDS, PATIENT_SECONDS, case_of
from tests.faults.kinds import EVERYBODY, KINDS, Fault
from tests.faults.moments import PHASES, Moment
from tests.faults.reference import Reference, in_memory, tables_of, unlike
from tests.faults.variants import VARIANTS, Variant
from tests.proxy import Cable

ROOT = Path(__file__).parents[2]
ENDURED, FAILED, INTERRUPTED = "82", "487", "55"
"""Three cases: a connection that is silent for a while, a killed estimator, and a hang-up."""


@pytest.mark.parametrize(
    "ends",
    [
        {FAILED: "failed by name"},
        pytest.param({ENDURED: "as if undisturbed", INTERRUPTED: "interrupted"}, marks=pytest.mark.long),
    ],
    ids=["failed", "endured and interrupted"],
)
def test_cases_of_the_campaign_keep_what_is_promised(ends: dict[str, str]) -> None:
    """One of each end, as `make test-faults` runs them. `tests/live` endures and interrupts runs in every `make test`."""
    command = [sys.executable, "-m", "tests.faults.campaign", "--seed", *ends]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    outcomes = {line.split()[0]: line for line in done.stdout.splitlines() if line.strip()}
    for case, end in ends.items():
        assert end in outcomes[case]
    assert f" in {len(ends)} runs, 0 with a miss" in done.stdout


def test_a_number_is_always_the_same_case() -> None:
    """And all variants, kinds, targets and phases come."""
    cases = [case_of(seed) for seed in range(400)]
    assert cases == [case_of(seed) for seed in range(400)]
    faults = [fault for case in cases for fault in case.faults]
    assert {case.variant.name for case in cases} == set(VARIANTS)
    assert {case.longest_outage for case in cases} == {PATIENT_SECONDS, HASTY_SECONDS}
    assert {fault.kind for fault in faults} == set(KINDS)
    assert {fault.moment.phase for fault in faults} == set(PHASES)
    processes = {name for variant in VARIANTS.values() for name in variant.processes}
    assert {fault.target for fault in faults} == {*processes, "launcher", EVERYBODY, "results"}
    assert {fault.shard for fault in faults} == {0, 1}


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the results of `reference` are."""
    return tmp_path_factory.mktemp("reference") / "memory"


@pytest.fixture(scope="module")
def reference(memory: Path) -> Reference:
    """The variant `plain` in memory."""
    return in_memory(VARIANTS["plain"].scenario(memory.parent), memory)


def test_wrong_rows_are_seen(reference: Reference, memory: Path) -> None:
    """A number that is off in its last bit, a row that is another's, one that is there twice; and no other."""
    tables = dict(tables_of(load_results(memory), journal=False))
    assert [line for name, table in tables.items() for line in reference.wrong_rows(name, table)] == []
    rows = tables["trials"].slice(100, 3).to_pylist()
    rows[0]["squared_error"] = math.nextafter(rows[0]["squared_error"], math.inf)
    rows[1]["peer"] = "smart" if rows[1]["peer"] != "smart" else "naive"
    wrong = pa.Table.from_pylist([*rows, rows[2]], schema=tables["trials"].schema.remove_metadata())
    found = list(reference.wrong_rows("trials", wrong))
    assert len(found) == 3
    assert "squared_error is" in found[0]
    assert "twice" in found[2]


def test_another_summary_is_seen(reference: Reference) -> None:
    """Another digest, another account of a link, a slot that is missing."""
    summary: dict[str, Any] = {
        **reference.summary,
        "slots": 1,
        "peers": {name: {**peer, "digest": "00"} for name, peer in reference.summary["peers"].items()},
        "links": {name: {**link, "delivered": 0} for name, link in reference.summary["links"].items()},
    }
    assert list(unlike(reference.summary, reference)) == []
    assert len(list(unlike(summary, reference))) == 1 + 2 * len(VARIANTS["plain"].receivers)


@dataclass
class Status:
    """A launcher that has ended."""

    returncode: int = 0


@dataclass
class Ended:
    """What the judge looks at of a run."""

    folder: Path
    out: Path
    launcher: Status = field(default_factory=Status)
    variant: Variant = VARIANTS["plain"]
    done: int = 400
    cables: dict[tuple[int, str], Cable] = field(default_factory=dict)

    @property
    def renamed(self) -> Path:
        """Nothing is there."""
        return self.folder / "renamed"

    @property
    def temporary(self) -> Path:
        """Empty, as it should be."""
        return self.folder / "temporary"

    def text(self, name: str) -> str:
        """What it wrote to stdout or stderr."""
        return (self.folder / name).read_text()


@pytest.fixture
def ended(tmp_path: Path, memory: Path, reference: Reference) -> Ended:
    """A run for the judge, which ended as if nothing had happened."""
    out = tmp_path / "run"
    shutil.copytree(memory, out)
    pq.write_table(JOURNAL.empty_table(), out / "journal.parquet")
    (tmp_path / "temporary").mkdir()
    for name in ("stdout", "stderr"):
        (tmp_path / name).touch()
    return Ended(tmp_path, out)


KILL = Fault("kill", "smart", Moment("run", 0.5))
FLAP = Fault("flap", "smart", Moment("run", 0.5), seconds=1.0, count=3)
SEEN: dict[str, tuple[int, str, list[Fault], str]] = {
    "a status that nothing explains": (3, "evedrop: smart left", [FLAP], "although nothing of this may end a run"),
    "somebody else blamed": (3, "evedrop: naive was ended by signal 9", [KILL], "names none of smart"),
    "a status that is none": (1, "", [KILL], "status 1"),
    "an interrupt out of nothing": (130, "evedrop: interrupted", [KILL], "no signal asked for the end"),
    "a traceback": (0, "Traceback (most recent call last):\n  boom", [], "has a traceback"),
}


@pytest.mark.parametrize("what", SEEN)
def test_the_judge_sees(what: str, ended: Ended, reference: Reference) -> None:
    """What a launcher must not do or say."""
    ended.launcher.returncode, said, hits, expected = SEEN[what]
    (ended.folder / "stderr").write_text(said)
    found = judge.misses(ended, hits, PATIENT_SECONDS, reference, frozenset(one.pid for one in ours.descendants()))
    assert [line for line in found if expected in line], found


def test_the_judge_sees_what_is_left_and_what_cannot_be_read(ended: Ended, reference: Reference) -> None:
    """A private folder, and a table that is cut off; of a run with which nothing is wrong it says nothing."""
    before = frozenset(one.pid for one in ours.descendants())
    assert judge.misses(ended, [], PATIENT_SECONDS, reference, before) == []
    slots = pq.read_table(ended.out / "slots.parquet")
    pq.write_table(slots.slice(0, slots.num_rows - 1), ended.out / "slots.parquet")
    lines = judge.misses(ended, [], PATIENT_SECONDS, reference, before)
    assert [line for line in lines if "the table of slots has" in line]
    pq.write_table(slots, ended.out / "slots.parquet")
    (ended.temporary / "evedrop-x").mkdir()
    whole = (ended.out / "slots.parquet").read_bytes()
    (ended.out / "slots.parquet").write_bytes(whole[: len(whole) // 2])
    lines = judge.misses(ended, [], PATIENT_SECONDS, reference, before)
    assert [line for line in lines if "evedrop-x is left" in line]
    assert [line for line in lines if "slots.parquet cannot be read" in line]
