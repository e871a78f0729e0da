"""Cases in which a study in memory is disturbed, and goes on with `--resume` to the results of an undisturbed one.

Source: docs/montecarlo.md, an interrupted study goes on.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from evedrop import montecarlo
from evedrop.errors import UsageError
from evedrop.results.reading import Results
from evedrop.virtual.metrics import unlike_memory
from tests.faults import ours
from tests.faults.looks import failed_looks

TRIALS, SLOTS, WORKERS = 4500, 200, 2
_SCENARIO = "eavesdroppers"
_TABLES = ("slots", "trials", "digests")
_ENDS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM, "hang up": signal.SIGHUP, "kill": signal.SIGKILL}
_INTERRUPTED, _FAILED = 130, 3
_END_SECONDS = 120.0
_LEAVE_SECONDS = 60.0


@dataclass(frozen=True)
class StudyFault:
    """What happens to one attempt at the study."""

    kind: str
    target: str
    """`study` or `worker`."""
    fraction: float
    """Of the time that an undisturbed study takes."""
    stopped: float | None
    """For how long the target is suspended before, if at all."""

    def __str__(self) -> str:
        stop = "" if self.stopped is None else f"stop {self.target} {self.stopped:.1f} s, "
        return f"{stop}{self.kind} {self.target} at {self.fraction:.2f}"


@final
@dataclass(frozen=True)
class StudyCase:
    """A study that is disturbed some times, and resumed until it is complete."""

    seed: int
    faults: tuple[StudyFault, ...]

    def __str__(self) -> str:
        return f"study: {'; '.join(map(str, self.faults))}"


def study_case(seed: int, draw: random.Random) -> StudyCase:
    """The case of a seed."""
    faults = []
    for _ in range(draw.choice((1, 1, 2))):
        target = draw.choice(("study", "worker"))
        kind = draw.choice([*_ENDS]) if target == "study" else draw.choice(("kill", "go on"))
        stopped = round(draw.uniform(0.1, 1.5), 2) if kind == "go on" or draw.random() < 0.3 else None
        faults.append(StudyFault(kind, target, round(draw.uniform(0.05, 0.9), 3), stopped))
    return StudyCase(seed, tuple(faults))


@dataclass(frozen=True)
class Undisturbed:
    """The study as it must end, and the seconds that it takes here, with its workers."""

    results: Results
    seconds: float


def undisturbed(folder: Path) -> Undisturbed:
    """The study in this process, and a command that does the same, to know how long that takes."""
    montecarlo(_SCENARIO, trials=TRIALS, slots=SLOTS, out=folder / "memory")
    begun = time.monotonic()
    with (folder / "said").open("w") as output:
        command = subprocess.run(_command("usual", False), cwd=folder, stdout=output, stderr=output, check=False)
    if command.returncode != 0:
        raise ValueError(f"an undisturbed study ends with status {command.returncode}: {(folder / 'said').read_text()}")
    return Undisturbed(Results.read(folder / "memory"), time.monotonic() - begun)


def _command(out: str, resume: bool) -> list[str]:
    words = [sys.executable, "-m", "evedrop", "montecarlo", _SCENARIO, "--trials", str(TRIALS), "--slots", str(SLOTS)]
    return [*words, "--set", "expect=[]", "--workers", str(WORKERS), "--out", out, *(["--resume"] if resume else [])]


def carried_out(case: StudyCase, folder: Path, before: frozenset[int], usual: Undisturbed) -> Iterator[str]:
    """Run a case; yields the broken promises."""
    temporary = folder / "temporary"
    temporary.mkdir(parents=True)
    complete = False
    for number, fault in enumerate((*case.faults, None)):
        if complete:
            break
        status, text = yield from _attempt(fault, folder, number, usual.seconds)
        complete = status == 0 or _interrupted_at_its_end(status, folder / "out")
        yield from _of_status(fault, status, text)
        left = ours.none_left(before, _LEAVE_SECONDS, temporary)
        yield from (
            f"process {process.pid} is left: {' '.join(process.words)}; {ours.doing(process.pid)}" for process in left
        )
        ours.end_all(left)
        yield from (f"{path} is left" for path in sorted(temporary.iterdir()))
        yield from _partial(folder / "out", complete)
    if not complete:
        yield "the study is not complete, although nothing disturbed its last attempt"
        return
    results = Results.read(folder / "out")
    yield from unlike_memory({**results.summary, "expectations": None}, {**usual.results.summary, "expectations": None})
    for name in _TABLES:
        actual, wanted = getattr(results, name), getattr(usual.results, name)
        if (
            not actual.equals(wanted)
            and actual.to_pylist() != wanted.to_pylist()
            and repr(actual.to_pylist()) != repr(wanted.to_pylist())
        ):
            yield f"the table of {name} is not that of an undisturbed study: {len(actual)} rows, wanted {len(wanted)}"
    if (folder / "out" / "finished_tasks").exists():
        yield "the kept trials are left in the folder of a complete study"
    yield from failed_looks(folder / "out", usual.results.folder)


def _attempt(fault: StudyFault | None, folder: Path, number: int, seconds: float) -> Any:
    """Begin or resume the study, and disturb it; returns its status and what it said."""
    environment = {**os.environ, "TMPDIR": str(folder / "temporary")}
    path = folder / f"attempt-{number}"
    with path.open("w") as output:
        study = subprocess.Popen(
            _command("out", number > 0),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=environment,
            start_new_session=True,
        )
    if fault is not None:
        with suppress(subprocess.TimeoutExpired):
            study.wait(fault.fraction * seconds)
        _strike(fault, study)
    try:
        status = study.wait(_END_SECONDS + seconds)
    except subprocess.TimeoutExpired:
        yield f"the study did not end within {_END_SECONDS + seconds:.0f} s"
        study.kill()
        status = study.wait()
    return status, path.read_text(errors="replace")


def _interrupted_at_its_end(status: int, out: Path) -> bool:
    """Whether a signal came when the study was complete on disk, while its report was made or printed."""
    signals = {_INTERRUPTED, *(-number for number in _ENDS.values())}
    if status not in signals or (out / "finished_tasks").exists():
        return False
    try:
        return bool(Results.read(out).summary["ended"] == "complete")
    except UsageError:
        return False


def _strike(fault: StudyFault, study: subprocess.Popen[bytes]) -> None:
    if study.poll() is not None:
        return
    pids = [study.pid]
    if fault.target == "worker":
        pids = [
            process.pid
            for process in ours.descendants()
            if "work" in " ".join(process.words) and process.pid != study.pid
        ][:1]
    for pid in pids:
        with suppress(ProcessLookupError):
            if fault.stopped is not None:
                os.kill(pid, signal.SIGSTOP)
                threading.Event().wait(fault.stopped)
                os.kill(pid, signal.SIGCONT)
            if fault.kind in _ENDS:
                os.kill(pid, _ENDS[fault.kind])


def _of_status(fault: StudyFault | None, status: int, text: str) -> Iterator[str]:
    if "Traceback (most recent call last)" in text:
        yield f"a traceback: {text.strip().splitlines()[-1]}"
    allowed = {0}
    if fault is not None and fault.target == "worker" and fault.kind == "kill":
        allowed.add(_FAILED)
        if status == _FAILED and "a worker process was ended by signal 9" not in text:
            yield f"the failure does not name the worker: {text.strip()[-300:]}"
    elif fault is not None and fault.kind == "kill":
        allowed.add(-signal.SIGKILL)
    elif fault is not None and fault.kind in _ENDS:
        allowed |= {_INTERRUPTED, -_ENDS[fault.kind]}  # by the signal itself, before the first line of ours
    if status not in allowed:
        yield f"status {status}: {text.strip()[-300:]}"


def _partial(out: Path, complete: bool) -> Iterator[str]:
    """An unfinished study can be read, unless it has just begun, and says that it is not complete."""
    if complete or not out.exists():
        return
    try:
        results = Results.read(out)
    except UsageError as error:
        if (
            "has nothing yet" not in str(error)
            and "has no metrics" not in str(error)
            and "is not a results folder" not in str(error)
        ):
            yield f"the unfinished study cannot be read: {error}"
        return
    if results.summary["ended"] == "complete":
        yield "the study is unfinished, and its summary says complete"
    trials = results.summary["trials"]
    if trials > TRIALS:
        yield f"the unfinished study has {trials} trials of {TRIALS}"
