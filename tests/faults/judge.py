"""Compares the outcome of a disturbed run with the promises."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import pyarrow.parquet as pq

from evedrop.errors import UsageError
from evedrop.results.writer import Results, load_results
from tests.faults import ours
from tests.faults.kinds import SIGNALS, Fault
from tests.faults.reference import Reference, tables_of, unlike
from tests.faults.variants import Variant
from tests.proxy import Cable

FAILED, INTERRUPTED, KILLED = 3, 130, -9
OUTCOMES = ("as if undisturbed", "failed by name", "interrupted", "launcher killed", "MISS")
_LEAVE_SECONDS = 25.0
"""For processes whose launcher was killed to write the results and end; and for all others."""


def outcome_of(status: int) -> str:
    """In a word."""
    return {0: OUTCOMES[0], FAILED: OUTCOMES[1], INTERRUPTED: OUTCOMES[2], KILLED: OUTCOMES[3]}.get(status, OUTCOMES[4])


class Launcher(Protocol):
    """A launcher that has ended."""

    @property
    def returncode(self) -> int:
        """Its exit status."""


class Run(Protocol):
    """The part of an ended run that the judge examines: a `Disturbed` has it."""

    @property
    def variant(self) -> Variant:
        """The kind of run."""

    @property
    def folder(self) -> Path:
        """Everything of it."""

    @property
    def out(self) -> Path:
        """Its results."""

    @property
    def renamed(self) -> Path:
        """Its results, if they were moved."""

    @property
    def temporary(self) -> Path:
        """Where its processes put what is temporary."""

    @property
    def launcher(self) -> Launcher:
        """Its launcher."""

    @property
    def done(self) -> int:
        """How many slots it said are done."""

    @property
    def cables(self) -> Mapping[tuple[int, str], Cable]:
        """Shard and process → its cable."""

    def text(self, name: str) -> str:
        """What it wrote to stdout or stderr."""


def misses(
    run: Run, hits: Sequence[Fault], longest_outage: float, reference: Reference, before: frozenset[int]
) -> list[str]:
    """The broken promises, now that the launcher has ended; hits: the faults that hit something."""
    left = ours.none_left(before, _LEAVE_SECONDS)
    found = [f"process {one.pid} is left: {' '.join(one.words)}; {ours.doing(one.pid)}" for one in left]
    ours.end_all(left)
    status = run.launcher.returncode
    found += _of_status(status, run, hits, longest_outage)
    found += _of_what_is_said(run)
    found += [f"{path} is left" for path in sorted(run.temporary.iterdir())]
    found += _of_ports(run)
    if not any(fault.kind == "remove" for fault in hits):
        found += _of_results(status, run, hits, reference)
    return found


def _of_status(status: int, run: Run, hits: Sequence[Fault], longest_outage: float) -> Iterator[str]:
    fatal = [fault for fault in hits if not fault.survived(longest_outage)]
    if status != 0 and not fatal:
        yield f"status {status}, although nothing of this may end a run: {_first_line(run)}"
    elif status == FAILED:
        complaint = _first_line(run)
        blamed = [word for fault in fatal for word in fault.blamed]
        if not any(word in complaint for word in blamed):
            yield f"the failure names none of {', '.join(blamed)}: {complaint or '(nothing was said)'}"
    elif status == INTERRUPTED:
        if not any(fault.kind in SIGNALS for fault in fatal):
            yield "status 130, but no signal asked for the end"
    elif status == KILLED:
        if not any(fault.kind == "kill" and fault.target == "launcher" for fault in fatal):
            yield "the launcher was killed by something else"
    elif status != 0:
        yield f"status {status}: {_first_line(run)}"


def _first_line(run: Run) -> str:
    complaints = [
        line for line in run.text("stderr").splitlines() if line.startswith("evedrop: ") and "warning" not in line
    ]
    return complaints[0] if complaints else run.text("stderr").strip().partition("\n")[0]


def _of_what_is_said(run: Run) -> Iterator[str]:
    """Tracebacks, wherever they are."""
    logs = [path for folder in _folders(run) for path in sorted(folder.glob("**/*.log"))]
    for path in (run.folder / "stdout", run.folder / "stderr", *logs):
        text = path.read_text(errors="replace")
        if "Traceback (most recent call last)" in text or "panicked at" in text:
            yield f"{path.relative_to(run.folder)} has a traceback: {text.strip().splitlines()[-1]}"


def _of_ports(run: Run) -> Iterator[str]:
    for cable in run.cables.values():
        if cable.leads_somewhere:
            yield f"a router of {cable} still listens"


def _folders(run: Run) -> list[Path]:
    """Where results are, or were moved to: those of each shard where they could not be made one."""
    found = [folder for folder in (run.out, run.renamed) if folder.is_dir()]
    return [one for folder in found for one in (sorted((folder / "shards").glob("*")) or [folder])]


def _of_results(status: int, run: Run, hits: Sequence[Fault], reference: Reference) -> Iterator[str]:
    disk = any(fault.target == "results" for fault in hits)
    folders = _folders(run)
    written = [folder for folder in folders if any(_has_rows(path) for path in folder.glob("**/*.parquet"))]
    for folder in folders:
        try:
            results = load_results(folder)
            tables = dict(tables_of(results))
        except UsageError as error:
            # Where nothing was measured there is nothing to read.
            if folder in written or (run.done and len(folders) == 1) or (status != KILLED and not disk):
                yield f"{folder.name} cannot be read: {error}"
            continue
        for name, table in tables.items():
            yield from reference.wrong_rows(name, table)
        if not disk:
            yield from _of_summary(status, run, hits, results, reference)
    if not folders and status == 0:
        yield "there are no results"


def _of_summary(status: int, run: Run, hits: Sequence[Fault], results: Results, reference: Reference) -> Iterator[str]:
    """Whether the summary says how it ended, and accounts for every packet; tables are whole up to what it says."""
    summary = results.summary
    unexplained = [name for name, link in summary["links"].items() if link["unexplained"]]
    if unexplained:
        yield f"packets to {', '.join(unexplained)} are unexplained"
    if status == 0:
        if summary["ended"] != "complete":
            yield f"the run ended well, and its summary says {summary['ended']}"
        yield from unlike(summary, reference)
        tables = dict(tables_of(results))
        for name, table in tables.items():
            if name in reference.tables and len(table) != len(reference.tables[name]):
                yield f"{name} has {len(table)} rows, not {len(reference.tables[name])}"
    # A signal may come when the run is complete, and end a launcher that prints its report.
    elif summary["ended"] == "complete" and status not in (KILLED, INTERRUPTED):
        yield f"status {status}, and the summary says complete"
    if not any(fault.target in ("observer", "launcher") and fault.kind == "kill" for fault in hits):
        if summary["slots"] < run.done:
            yield f"{run.done} slots were done, and the summary has {summary['slots']}"
        rows, whole = len(results.slots), summary["slots"] * len(run.variant.receivers)
        # Shards that were cut short at different slots leave rows for slots that only some of them reached: with fewer trials.
        trials = results.slots["trials"].to_numpy()
        further = results.slots["slot"].to_numpy() >= summary["slots"]
        if rows - further.sum() != whole or (trials[further] >= summary["trials"]).any():
            yield f"the table of slots has {rows} rows, and {summary['slots']} slots were measured"


def _has_rows(path: Path) -> bool:
    try:
        return bool(pq.read_metadata(path).num_rows)
    except Exception:  # whatever is wrong with it: it is there, and must be readable
        return path.stat().st_size > 0
