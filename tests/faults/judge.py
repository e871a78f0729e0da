"""Compares the outcome of a disturbed run with the promises."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import pyarrow.parquet as pq

from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.virtual.reference import RunReference, tables_of
from evedrop.virtual.results import wrong_outages, wrong_summary, wrong_tables
from tests.faults import ours
from tests.faults.disturbed import CLEANER, CONFUSED_FILE, FORK_SERVERS
from tests.faults.hosts import HOST_CLEANER, PROGRAM, host_of, target_on
from tests.faults.kinds import KILLING, LIMITS, RESULTS, SIGNALS, Fault
from tests.faults.looks import failed_looks
from tests.faults.outages import unexplained_outages
from tests.faults.over_ssh import ended_late, unlike_first_line, unlike_refusal
from tests.faults.variants import Variant
from tests.proxy import Cable

UNUSABLE, FAILED, INTERRUPTED, KILLED = 2, 3, 130, -9
OUTCOMES = ("as if undisturbed", "failed by name", "interrupted", "launcher killed", "MISS")
_HEEDED_SECONDS = 1.0
"""After a signal to the launcher a run that has slots to come does not complete."""
_LEAVE_SECONDS = 40.0
"""For processes whose launcher was killed to write the results and end; and for all others. A recorder takes 30 at most."""
_OF_C_LIBRARY, _ENDED_BY_C_LIBRARY = 127, "cannot allocate memory for thread-local data: ABORT"
_OF_ZENOH = re.compile(r"panicked at \S*/zenoh[^\s/]*/\S+\.rs")


def outcome_of(status: int) -> str:
    """In a word."""
    return {
        0: OUTCOMES[0],
        FAILED: OUTCOMES[1],
        UNUSABLE: OUTCOMES[1],
        INTERRUPTED: OUTCOMES[2],
        KILLED: OUTCOMES[3],
    }.get(status, OUTCOMES[4])


def status_of(run: Run) -> int:
    """The exit status of a run's launcher. If the C library ended it, that of a launcher that was killed.

    It does so where it has no memory for the variables of a thread, with a status and a line of its own.
    """
    status = run.launcher.returncode
    return KILLED if status == _OF_C_LIBRARY and _ENDED_BY_C_LIBRARY in run.text("stderr") else status


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
    def temporaries(self) -> Mapping[str, Path]:
        """Where its processes put what is temporary: host → its folder, and "" → that of this machine."""

    @property
    def ended(self) -> float | None:
        """When its launcher ended."""

    @property
    def launcher(self) -> Launcher:
        """Its launcher."""

    @property
    def done(self) -> int:
        """How many slots it said are done."""

    @property
    def cables(self) -> Mapping[tuple[int, str], Cable]:
        """Shard and process → its cable."""

    @property
    def told(self) -> Sequence[Mapping[str, Any]]:
        """Its events, each with the time `at` which it came."""

    def text(self, name: str) -> str:
        """What it wrote to stdout or stderr."""


def misses(
    run: Run, hits: Mapping[Fault, float], longest_outage: float, reference: RunReference, before: frozenset[int]
) -> list[str]:
    """The broken promises, now that the launcher has ended; hits: the faults that hit something, and when."""
    left = ours.none_left(before, _LEAVE_SECONDS, *run.temporaries.values())
    misses = [
        f"process {process.pid} is left: {' '.join(process.words)}; {ours.doing(process.pid)}" for process in left
    ]
    ours.end_all(left)
    status = status_of(run)
    misses += _of_status(status, run, hits, longest_outage, int(reference.summary["slots"]))
    misses += _of_what_is_said(run, any(map(_of_limits, hits)))
    for host, folder in run.temporaries.items():
        if not _may_leave_files(status, [*hits], host):
            misses += [f"{path} is left" for path in sorted(folder.iterdir())]
    misses += _of_ports(run)
    if not any(fault.kind in ("remove", "break the disk") for fault in hits):
        misses += _of_results(status, run, hits, reference)
        misses += _of_files(status, run, any(_of_disk(fault) or _of_limits(fault) for fault in hits))
    return misses


def _may_leave_files(status: int, hits: Sequence[Fault], host: str) -> bool:
    """Whether a private folder is removed by the next run only: its launcher, or host, and its cleaner were killed."""
    killed = {fault.target for fault in hits if fault.kind in KILLING}
    if host:
        return {target_on(PROGRAM, host), target_on(HOST_CLEANER, host)} <= killed
    return status == KILLED and CLEANER in killed


def _of_status(status: int, run: Run, hits: Mapping[Fault, float], longest_outage: float, slots: int) -> Iterator[str]:
    """Whether the status, and the first line, say what happened; slots: of the whole run."""
    fatal = [fault for fault in hits if not fault.survived(longest_outage)]
    if run.ended is not None:
        yield from ended_late(run.told, run.ended, hits, slots)
    if status != 0 and not fatal:
        yield f"status {status}, although nothing of this may end a run: {_first_line(run)}"
    elif status == 0:
        yield from _of_ignored_signals(run, fatal, hits, slots)
    elif status == UNUSABLE and (run.variant.hosts or any(map(_of_disk, fatal))):
        yield from _of_refusal(run, fatal)
    elif status == FAILED:
        # Which process lacked something is said first, and what it lacked comes from its log.
        complaint = run.text("stderr") if any(map(_of_limits, fatal)) else _first_line(run)
        blamed = [word for fault in fatal for word in fault.blamed]
        if not any(word in complaint for word in blamed):
            yield f"the failure names none of {', '.join(blamed)}: {complaint or '(nothing was said)'}"
        yield from unlike_first_line(_first_line(run), fatal, run.variant.hosts)
    elif status == INTERRUPTED:
        if not any(fault.kind in SIGNALS and not host_of(fault.target) for fault in fatal):
            yield "status 130, but no signal asked for the end"
    elif status == KILLED:
        killed = any(fault.kind in KILLING and fault.target == "launcher" for fault in fatal)
        if not killed and (
            run.launcher.returncode == KILLED or not any(fault.kind == "little memory" for fault in fatal)
        ):
            yield "the launcher was killed by something else"
    elif status != 0:
        yield f"status {status}: {_first_line(run)}"


def _of_refusal(run: Run, fatal: Sequence[Fault]) -> Iterator[str]:
    """Whether a run that ended before anything was started says why."""
    if run.variant.hosts:
        yield from unlike_refusal(_first_line(run), fatal, _folders(run))
    elif "cannot be written" not in _first_line(run):
        yield f"status 2: {_first_line(run)}"


def _of_ignored_signals(run: Run, fatal: Sequence[Fault], hits: Mapping[Fault, float], slots: int) -> Iterator[str]:
    """A launcher that is told to end while slots are to come ends the run, rather than complete it.

    It hears the events of the run in the loop in which it heeds signals, so that it is late for both on a busy machine.
    """
    for fault in fatal:
        late = hits[fault] + _HEEDED_SECONDS
        progress = [event for event in run.told if event["event"] == "progress" and event["at"] > late]
        if fault.kind in SIGNALS and fault.target == "launcher" and any(event["done"] < slots for event in progress):
            yield f"the run went on to its end, {_HEEDED_SECONDS:.0f} s and more after {fault}"


def _first_line(run: Run) -> str:
    complaints = [
        line for line in run.text("stderr").splitlines() if line.startswith("evedrop: ") and "warning" not in line
    ]
    return complaints[0] if complaints else run.text("stderr").strip().partition("\n")[0]


def _of_what_is_said(run: Run, limited: bool) -> Iterator[str]:
    """Tracebacks, wherever they are. limited: whether the run had too few threads or too little memory."""
    logs = [path for folder in _folders(run) for path in sorted(folder.glob("**/*.log"))]
    hosts = [run.folder / f"{host}.stderr" for host in run.variant.hosts]
    for path in (run.folder / "stdout", run.folder / "stderr", *filter(Path.exists, hosts), *logs):
        try:
            text = path.read_text(errors="replace")
        except OSError:  # its disk is broken
            continue
        # Where no thread can be started, Zenoh panics in its own; and elsewhere by a mistake of its own, which must cost nothing.
        panic = limited and "OS can't spawn worker thread" in text
        panic |= run.launcher.returncode == 0 and "Traceback" not in text and bool(_OF_ZENOH.search(text))
        if not panic and ("Traceback (most recent call last)" in text or "panicked at" in text):
            yield f"{path.relative_to(run.folder)} has a traceback: {text.strip().splitlines()[-1]}"


def _of_ports(run: Run) -> Iterator[str]:
    for cable in run.cables.values():
        if cable.leads_somewhere:
            yield f"a router of {cable} still listens"


def _of_files(status: int, run: Run, lacking: bool) -> Iterator[str]:
    """Files that others may read, and those of a run that goes on, which a run that has ended does not have.

    lacking: whether the run had too little of something to clean up.
    """
    for folder in (run.out, run.renamed):
        for path in sorted(folder.glob("**/*")):
            if path.stat().st_mode & 0o077:
                yield f"others may use {path.relative_to(run.folder)}, whose mode is {path.stat().st_mode & 0o777:o}"
            if status != KILLED and not lacking and path.name in ("control.json", "unfinished"):
                yield f"{path.relative_to(run.folder)} is left of the run"


def _folders(run: Run) -> list[Path]:
    """Where results are, or were moved to: those of each shard where they could not be made one."""
    folders = [folder for folder in (run.out, run.renamed) if folder.is_dir()]
    return [shard for folder in folders for shard in (sorted((folder / "shards").glob("*")) or [folder])]


def _of_results(status: int, run: Run, hits: Mapping[Fault, float], reference: RunReference) -> Iterator[str]:
    disk, limited = any(map(_of_disk, hits)), any(map(_of_limits, hits))
    folders = {place: due for folder in (run.out, run.renamed) for place, due in reference.of_folders(folder).items()}
    written = [folder for folder in folders if any(_has_rows(path) for path in folder.glob("**/*.parquet"))]
    for folder, expected in folders.items():
        try:
            results = Results.read(folder)
            tables = dict(tables_of(results))
        except UsageError as error:
            # Where nothing was measured there is nothing to read.
            if folder in written or (run.done and len(folders) == 1) or (status != KILLED and not disk and not limited):
                yield f"{folder.name} cannot be read: {error}"
            continue
        summary = results.summary
        yield from wrong_tables(tables, summary, expected, status == 0)
        if not disk:
            yield from _of_summary(status, run, hits, summary, expected)
        yield from failed_looks(folder, reference.folder if summary["slots"] else None)
    if not folders and status == 0:
        yield "there are no results"


def _of_summary(
    status: int, run: Run, hits: Mapping[Fault, float], summary: Mapping[str, Any], reference: RunReference
) -> Iterator[str]:
    """Whether the summary says how the run ended and what it went through, and accounts for every packet."""
    yield from wrong_summary(summary, reference, status == 0)
    if status == 0:
        if (run.folder / CONFUSED_FILE).exists() and not summary["misdelivered"]:
            yield "messages came on keys that they do not name, and the summary lists none"
    # A signal may come when the run is complete, and end a launcher that prints its report.
    elif summary["ended"] == "complete" and status not in (KILLED, INTERRUPTED):
        yield f"status {status}, and the summary says complete"
    if any(fault.target in ("recorder", "launcher", *FORK_SERVERS) and fault.kind in KILLING for fault in hits):
        return
    if summary["slots"] < run.done:
        yield f"{run.done} slots were done, and the summary has {summary['slots']}"
    complete = summary["ended"] == "complete"
    slots = int(reference.summary["slots"])
    reconnected = {(event["process"], event["slot"]) for event in run.told if event["event"] == "reconnected"}
    yield from wrong_outages(summary, reference, frozenset(reconnected))
    yield from unexplained_outages(summary["outages"], run.told, hits, slots, complete)


def _of_disk(fault: Fault) -> bool:
    return fault.target == RESULTS


def _of_limits(fault: Fault) -> bool:
    return fault.kind in LIMITS


def _has_rows(path: Path) -> bool:
    try:
        return bool(pq.read_metadata(path).num_rows)
    except Exception:  # whatever is wrong with it: it is there, and must be readable
        return path.stat().st_size > 0
