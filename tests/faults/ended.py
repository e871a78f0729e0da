"""Runs that have ended, made from results in memory, for the tests of the judge."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from evedrop.results.tables import JOURNAL
from evedrop.virtual.reference import RunReference, journal_rows
from tests.faults import judge, ours
from tests.faults.cases import PATIENT_SECONDS
from tests.faults.kinds import Fault
from tests.faults.variants import VARIANTS, Variant
from tests.proxy import Cable

EARLY = 150
"""The slot at which a run that ends early ends."""


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
    told: list[dict[str, Any]] = field(default_factory=list)
    ended: float | None = None

    @property
    def renamed(self) -> Path:
        """Nothing is there."""
        return self.folder / "renamed"

    @property
    def temporaries(self) -> dict[str, Path]:
        """All empty, as they should be."""
        return {"": self.folder / "temporary", **{host: self.folder / host for host in self.variant.hosts}}

    def spread(self, variant: Variant) -> None:
        """Take it for a run of a variant over ssh, whose scenario is the same."""
        self.variant = variant
        for host in variant.hosts:
            self.temporaries[host].mkdir()

    def text(self, name: str) -> str:
        """What it wrote to stdout or stderr."""
        return (self.folder / name).read_text()

    def change(self, name: str, change: Callable[[pa.Table], pa.Table]) -> None:
        """Replace one of its tables."""
        path = self.out / f"{name}.parquet"
        pq.write_table(change(pq.read_table(path)), path)

    def edit(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Change its summary."""
        path = self.out / "summary.json"
        summary = json.loads(path.read_text())
        change(summary)
        path.write_text(json.dumps(summary))

    def misses(self, reference: RunReference, *hits: Fault) -> list[str]:
        """The complaints of the judge about it, given that all of these faults struck at 1.0 s."""
        before = frozenset(process.pid for process in ours.descendants())
        return judge.misses(self, dict.fromkeys(hits, 1.0), PATIENT_SECONDS, reference, before)


def copy_of(run: Ended, folder: Path) -> Ended:
    """The same run in another folder, which may be there."""
    shutil.copytree(run.folder, folder, dirs_exist_ok=True)
    return Ended(folder, folder / "run", Status(run.launcher.returncode), done=run.done)


def ended_run(folder: Path, results: Path, slots: int, how: str) -> Ended:
    """A run for the judge, from results in memory: as a live run writes them, with its journal and its own entries."""
    out = folder / "run"
    shutil.copytree(results, out)
    rows = [row for row in journal_rows(VARIANTS["plain"].scenario(folder)) if row["slot"] < slots]
    pq.write_table(pa.Table.from_pylist(rows, schema=JOURNAL), out / "journal.parquet")
    (folder / "temporary").mkdir()
    for name in ("stdout", "stderr"):
        (folder / name).touch()
    run = Ended(folder, out, done=slots)

    def as_live(summary: dict[str, Any]) -> None:
        names = VARIANTS["plain"].receivers
        checked = {name: {"recomputed_trials": 1, "verified": [], "own_word": []} for name in names}
        summary |= {"mode": "live", "ended": how, "verification": checked, "outages": []}

    run.edit(as_live)
    return run
