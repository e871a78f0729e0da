"""Carries out a scenario as a test, for both the pytest plugin and `evedrop test`.

Source: docs/testing.md.
"""

from __future__ import annotations

import contextlib
import glob
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from evedrop.errors import Interrupted, RunError, ScenarioError, UsageError
from evedrop.live.launch.launcher import launch
from evedrop.results.folder import claimed, default_folder
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import resolved
from evedrop.scenario.discovery import scenarios_in
from evedrop.scenario.loading import load, shipped
from evedrop.scenario.progress_events import silent
from evedrop.scenario.tables import Scenario
from evedrop.score.summary import Judged, failed
from evedrop.show.report.writing import has_results, try_report
from evedrop.simulate.kept_tasks import KEPT
from evedrop.simulate.montecarlo import Plan, simulate


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
    trials: int | None = None
    """None: the scenario's number."""
    out: Path | None = None
    """The folder for all results folders; None: runs/."""
    workers: int | None = None
    """Worker processes of a test in memory; None: as in `Plan`."""
    scheduler: str | None = None
    """Address of a Dask scheduler, for tests in memory."""
    resume: bool = False
    """Whether to go on with tests in memory that were interrupted: those that ended keep their results."""

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

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines to print if it did not pass."""
        kept = () if self.folder is None or self.outcome is Outcome.PASSED else (f"results: {self.folder}",)
        page = () if self.report is None or self.outcome is Outcome.PASSED else (f"report: {self.report}",)
        return (*self.reasons, *kept, *page)


def scenarios_of(places: Sequence[str]) -> list[str]:
    """The scenarios in files, folders and built-in names, each once. Raises UsageError if none is found."""
    scenarios: dict[Path, str] = {}
    for place in places:
        paths: Sequence[Path] = [Path(place)]
        if place in shipped():
            scenarios.setdefault(shipped()[place].resolve(), place)
            continue
        if Path(place).is_dir():
            paths = list(scenarios_in(Path(place)))
        for path in paths:
            scenarios.setdefault(path.resolve(), str(path))
    if not scenarios:
        raise UsageError(f"no scenario in {', '.join(places)}; a scenario is a TOML file with [process] and [encoding]")
    return list(scenarios.values())


def carry_out(scenario: str, manner: Manner) -> Finding:
    """Run a scenario, live without a view or in memory, into a results folder of its own, which is kept.

    Raises Interrupted on Ctrl-C.
    """
    started = time.monotonic()
    changes = {} if manner.trials is None else {"trials": manner.trials}

    def ended(outcome: Outcome, reasons: Sequence[str], **more: Any) -> Finding:
        return Finding(scenario, outcome, time.monotonic() - started, tuple(reasons), **more)

    try:
        made = load(scenario, changes)
        folder = _folder_for(scenario, made, manner)
    except ScenarioError as error:
        return ended(Outcome.MISTAKES, error.mistakes)
    except UsageError as error:
        return ended(Outcome.MISTAKES, [str(error)])
    try:
        if not _has_ended(folder):
            folder = _run(made, folder, manner)
    except Interrupted as error:
        error.resumable = manner.resumable
        raise
    except UsageError as error:
        return ended(Outcome.MISTAKES, [str(error)], seed=made.seed)
    except RunError as error:
        kept = {"seed": made.seed, "folder": folder, "report": try_report(folder) if has_results(folder) else None}
        return ended(Outcome.BROKEN, str(error).splitlines(), **kept)
    kept = {"seed": made.seed, "folder": folder, "report": try_report(folder)}
    reasons = list(_reasons(Results.read(folder).typed_summary.expectations))
    return ended(Outcome.FAILED if reasons else Outcome.PASSED, reasons, **kept)


def _folder_for(scenario: str, made: Scenario, manner: Manner) -> Path:
    """The results folder of a scenario: a new one, or when tests are resumed the one that already has this very scenario."""
    if manner.out is None:
        return claimed(default_folder(scenario))
    wanted = manner.out / Path(scenario).stem
    if manner.resume:
        text = resolved(made)
        for folder in (wanted, *sorted(manner.out.glob(f"{glob.escape(wanted.name)}-*"))):
            with contextlib.suppress(OSError, ValueError):
                if (folder / "scenario.toml").read_text(encoding="utf-8") == text:
                    return folder
    return claimed(wanted)


def _has_ended(folder: Path) -> bool:
    """Whether a folder has the results of a study that is complete."""
    return has_results(folder) and not (folder / KEPT).exists()


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
