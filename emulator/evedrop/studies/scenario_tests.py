"""Carries out scenarios as tests, for both the pytest plugin and `evedrop test`.

Several at a time run each in a process of its own, which ends with the process that started it.

Source: docs/testing.md.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, final

from evedrop.errors import Interrupted, RunError, ScenarioError, UsageError
from evedrop.live.launch.launcher import launch
from evedrop.live.network.launcher_pipe import when_launcher_is_gone
from evedrop.results.folder import claimed, default_folder
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import input_texts, resolved
from evedrop.scenario.discovery import scenarios_in
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import silent
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed
from evedrop.scenarios import shipped
from evedrop.score.summary import Judged, failed
from evedrop.show.report.writing import has_results, try_report
from evedrop.simulate.finished_tasks import TASKS
from evedrop.simulate.montecarlo import Plan, simulate
from evedrop.simulate.simulation import Mode
from evedrop.studies.simulated_tests import SeedsToPlay, check_simulated, play_seeds
from evedrop.system.output import warn
from evedrop.system.parents import continue_when_parent_dies
from evedrop.system.processes import SUSPENDED_SECONDS, SuspensionWatch, kill, wait_for
from evedrop.system.signals import stop_on_signals


class Outcome(Enum):
    """The outcome of a test; its value is the exit status."""

    PASSED = 0
    FAILED = 1
    """An expectation failed."""
    MISTAKES = 2
    """The scenario has mistakes, or nothing could be started."""
    BROKEN = 3
    """The run itself failed."""

    @property
    def word(self) -> str:
        """The outcome as a printed word."""
        return self.name.lower() if self is Outcome.PASSED else self.name


@dataclass(frozen=True)
class Manner:
    """The options for carrying out tests."""

    in_memory: bool = False
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted key → value: changes of every scenario."""
    out: Path | None = None
    """The folder for all results folders; None: runs/."""
    workers: int | None = None
    """Worker processes of a test in memory; None: as in `Plan`."""
    scheduler: str | None = None
    """Address of a Dask scheduler, for tests in memory."""
    resume: bool = False
    """Whether to go on with tests in memory that were interrupted: those that ended keep their results."""

    simulation: SeedsToPlay | None = None
    """How to run scenarios in the simulated world; None: not there."""

    @property
    def resumable(self) -> str | None:
        """The folder from which interrupted tests can be resumed; None for live ones, and without a folder of their own."""
        return str(self.out) if self.in_memory and self.out is not None else None

    @property
    def folder(self) -> Path:
        """The folder for all results folders."""
        return Path("runs") if self.out is None else self.out


@dataclass(frozen=True)
class Finding:
    """The result of one scenario as a test."""

    scenario: str
    outcome: Outcome
    seconds: float
    reasons: tuple[str, ...] = ()
    """The reasons why it did not pass, one line each."""
    seed: int | None = None
    folder: Path | None = None
    """The results folder."""
    report: Path | None = None
    """Its report.html; None if it has no report."""
    verdict: str | None = None
    """The sentence of the run's verdict; None without an eavesdropper, and if the scenario could not be run."""
    told: str | None = None
    """What is said about it even if it passed."""
    story: str = ""
    """What happened, as a diagram."""

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines to print about it, most of them only if it did not pass."""
        kept = () if self.folder is None or self.outcome is Outcome.PASSED else (f"results: {self.folder}",)
        page = () if self.report is None or self.outcome is Outcome.PASSED else (f"report: {self.report}",)
        told = () if self.told is None else (self.told,)
        return (*told, *self.reasons, *kept, *page, *self.story.splitlines())


def scenarios_of(places: Sequence[str]) -> list[str]:
    """The scenarios in files, folders and built-in names, each once. Warns of a folder without one.

    Raises UsageError if there is none at all.
    """
    scenarios: dict[Path, str] = {}
    empty: list[str] = []
    for place in places:
        paths: Sequence[Path] = [Path(place)]
        if place in shipped():
            scenarios.setdefault(shipped()[place].resolve(), place)
            continue
        if Path(place).is_dir():
            paths = list(scenarios_in(Path(place)))
            if not paths:
                empty.append(place)
        for path in paths:
            scenarios.setdefault(
                Path(os.path.realpath(path)), str(path)
            )  # a link to itself is reported when it is read
    if empty:
        told = f"no scenario in {listed(empty)}; a scenario is a TOML file with [process] and [encoding]"
        if not scenarios:
            raise UsageError(told)
        warn(told)
    return list(scenarios.values())


def carry_out(scenario: str, manner: Manner) -> Finding:
    """Run a scenario, live without a view or in memory, into a results folder of its own, which is kept.

    Raises Interrupted on Ctrl-C.
    """
    started = time.monotonic()

    def ended(outcome: Outcome, reasons: Sequence[str], **more: Any) -> Finding:
        return Finding(scenario, outcome, time.monotonic() - started, tuple(reasons), **more)

    try:
        made = load(scenario, manner.changes)
        if manner.simulation is not None:
            check_simulated(made)
        folder = _folder_for(scenario, made, manner)
    except ScenarioError as error:
        return ended(Outcome.MISTAKES, error.mistakes)
    except UsageError as error:
        return ended(Outcome.MISTAKES, [str(error)])
    played = None
    try:
        if manner.simulation is not None:
            played = play_seeds(made, scenario, folder, manner.simulation, manner.changes)
        elif not _is_complete(folder):
            folder = _run(made, folder, manner)
    except Interrupted as error:
        error.resumable = manner.resumable
        raise
    except UsageError as error:
        return ended(Outcome.MISTAKES, [str(error)], seed=made.seed)
    except RunError as error:
        page = try_report(folder) if has_results(folder) else None
        return ended(Outcome.BROKEN, str(error).splitlines(), seed=made.seed, folder=folder, report=page)
    kept: dict[str, Any] = {"seed": made.seed, "folder": folder, "report": try_report(folder)}
    summary = Results.read(folder).typed_summary
    reasons = list(_reasons(summary.expectations))
    if summary.verdict is not None:
        kept["verdict"] = summary.verdict.sentence
    outcome = Outcome.FAILED if reasons else Outcome.PASSED
    if played is not None:
        kept |= {"told": played.told, "story": played.story}
        reasons += played.reasons
        outcome = Outcome.BROKEN if played.reasons else outcome
    return ended(outcome, reasons, **kept)


def _folder_for(scenario: str, made: Scenario, manner: Manner) -> Path:
    """The results folder of a scenario: a new one, or when tests are resumed the one with the test of this very scenario.

    That of a live run, of one that failed, or of a complete one with a secret from a file, is left as it is.
    """
    if manner.out is None:
        return claimed(default_folder(scenario))
    wanted = manner.out / Path(scenario).stem
    if manner.resume:
        texts = {**input_texts(made), "scenario.toml": resolved(made)}
        for folder in (wanted, *sorted(manner.out.glob(f"{glob.escape(wanted.name)}-*"))):
            with contextlib.suppress(OSError, ValueError):
                same = all((folder / name).read_text(encoding="utf-8") == text for name, text in texts.items())
                # The results of a complete run do not record its secret; those of an interrupted run do.
                reusable = (folder / TASKS).exists() or (made.secret_file is None and _is_complete(folder))
                if same and reusable:
                    return folder
    return claimed(wanted)


def _is_complete(folder: Path) -> bool:
    """Whether a folder has all results of a test in memory."""
    try:
        summary = Results.read(folder).typed_summary
    except UsageError:
        return False
    return (summary.ended, summary.mode) == ("complete", Mode.EXACT.value) and not (folder / TASKS).exists()


def _run(scenario: Scenario, folder: Path, manner: Manner) -> Path:
    """Run a scenario into a folder; returns the results folder."""
    if manner.in_memory:
        plan = Plan(workers=manner.workers, scheduler=manner.scheduler)
        simulate(scenario, folder, silent, plan, resume=manner.resume)
        return folder
    return launch(scenario, folder, "off", None, silent).folder


def _reasons(expectations: Sequence[Judged]) -> Iterator[str]:
    """A line for each expectation that failed."""
    for judged in failed(expectations):
        yield judged.sentence + (f"; see it again: {judged.replay}" if judged.replay is not None else "")


_POLL_SECONDS = 0.1
_END_SECONDS = 60.0
"""For the processes to end their runs, which takes seconds, and to write the results so far."""
_WORK = "from evedrop.studies.scenario_tests import work; work()"


def results(scenarios: Sequence[str], manner: Manner, jobs: int) -> Iterator[Finding]:
    """Carry out the scenarios as tests; yields the results in order. Raises Interrupted on Ctrl-C; then no process is left."""
    if jobs == 1:
        with stop_on_signals() as stop:
            for scenario in scenarios:
                if stop.is_set():
                    raise _interrupted(manner)
                yield carry_out(scenario, manner)
        return
    crew = _Crew(replace(manner, workers=1))
    with stop_on_signals() as stop, ThreadPoolExecutor(jobs) as threads:
        waiting = [threads.submit(crew.carry_out, scenario) for scenario in scenarios]
        try:
            for future in waiting:
                while not wait([future], _POLL_SECONDS).done:
                    if stop.is_set():
                        raise _interrupted(manner)
                    crew.kill_suspended()
                yield future.result()
        finally:
            crew.end(waiting)


def _interrupted(manner: Manner) -> Interrupted:
    error = Interrupted.with_results(manner.folder)
    error.resumable = manner.resumable
    return error


@final
class _Crew:
    """The running processes."""

    def __init__(self, manner: Manner) -> None:
        self._manner = manner
        self._running: dict[int, subprocess.Popen[str]] = {}
        self._over = False
        self._watch = SuspensionWatch()
        self._suspended = set[int]()
        """Ids of processes that were killed because they stayed suspended."""

    def carry_out(self, scenario: str) -> Finding:
        """Carry out one scenario in a process that a Ctrl-C in the terminal does not reach: this process passes it on."""
        task = json.dumps([scenario, asdict(self._manner)], default=str)
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _WORK, task],
            stdin=subprocess.PIPE,  # closes when this process is gone
            stdout=subprocess.PIPE,
            encoding="ascii",  # JSON
            errors="replace",
            start_new_session=True,
        )
        with process:
            self._running[process.pid] = process
            if self._over:
                process.terminate()
            assert process.stdout is not None  # noqa: S101 - it was started with a pipe
            output = process.stdout.read()
            status = process.wait()
            del self._running[process.pid]
        try:
            entries = json.loads(output)
        except ValueError:
            how = f"ended with status {status} and without a result"
            if process.pid in self._suspended:
                how = f"was suspended for {SUSPENDED_SECONDS:g} s (SIGSTOP)"
            return Finding(scenario, Outcome.BROKEN, 0.0, (f"its process {how}",))
        places = {name: None if entries[name] is None else Path(entries[name]) for name in ("folder", "report")}
        return Finding(
            **{**entries, **places, "outcome": Outcome(entries["outcome"]), "reasons": (*entries["reasons"],)}
        )

    def kill_suspended(self) -> None:
        """Kill a process that stays suspended."""
        if (pid := self._watch.suspended_for_good(tuple(self._running))) is not None:
            self._suspended.add(pid)
            self._running[pid].kill()

    def end(self, waiting: Sequence[Future[Finding]]) -> None:
        """Start no further processes, and end the running ones, also suspended ones; kill those that do not end."""
        for future in waiting:
            future.cancel()
        self._over = True
        for process in tuple(self._running.values()):
            process.send_signal(signal.SIGCONT)
            process.terminate()
        wait_for(tuple(self._running.values()), _END_SECONDS)
        kill(*tuple(self._running.values()))


def work() -> None:
    """Run one process: carry out the scenario in its argument, and write the result to standard output.

    All else that is printed, as by a class of the user's own, goes to standard error.
    """
    result = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    continue_when_parent_dies()
    when_launcher_is_gone(lambda: os.kill(os.getpid(), signal.SIGTERM))
    scenario, manner = json.loads(sys.argv[1])
    out = None if manner["out"] is None else Path(manner["out"])
    simulation = None if manner["simulation"] is None else SeedsToPlay(**manner["simulation"])
    try:
        tested = carry_out(scenario, Manner(**{**manner, "out": out, "simulation": simulation}))
    except Interrupted as error:
        sys.exit(error.exit_status)
    with open(result, "w", encoding="ascii") as answer:
        answer.write(json.dumps({**asdict(tested), "outcome": tested.outcome.value}, default=str))
