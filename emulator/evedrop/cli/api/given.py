"""The arguments that calls share: a scenario, a folder for the results, the number of workers, and changes."""

from __future__ import annotations

import atexit
import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

from evedrop.errors import EvedropError, UsageError
from evedrop.results.growing_tables import goes_on
from evedrop.scenario.arguments import CHANGES, path_argument, refuse_unless, table_argument
from evedrop.scenario.loading import prepared
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import dotted
from evedrop.simulate.montecarlo import Plan
from evedrop.studies.parts import StudyPlace

_OF_RESULTS = ("summary.json", "unfinished", "shards", "sweep.json", "compare.json", "kept")
"""Files and folders that show that a folder is a results folder."""
_NO_FOLDER = "resume=True goes on with the study in a folder: give the folder as out, and leave overwrite out"


def scenario_of(scenario: str | Path | Scenario, changes: Mapping[str, Any], beyond_horizon: bool = False) -> Scenario:
    """The scenario of a call, with its changes. Raises ScenarioError with every mistake."""
    return prepared(scenario, dotted(table_argument("changes", changes, CHANGES)), beyond_horizon=beyond_horizon)


def plan_of(plan: Plan | None, workers: int | None, scheduler: str | None) -> Plan:
    """The plan of a call, whose own workers and scheduler give way to these. Raises UsageError as `Plan` does."""
    refuse_unless(plan is None or isinstance(plan, Plan), "plan", plan, 'a Plan, such as Plan(mode="covariance-only")')
    base = plan or Plan()
    return replace(
        base,
        workers=base.workers if workers is None else workers,
        scheduler=base.scheduler if scheduler is None else scheduler,
    )


@final
@dataclass
class ResultsPlace:
    """Where a call writes: the folder that it was given, or a temporary one."""

    folder: Path
    temporary: bool
    _kept: bool = field(default=False, init=False)

    def keep_for(self, results: object) -> None:
        """Keep a temporary folder as long as the results object exists, and this program runs."""
        if self.temporary:
            self._kept = True
            weakref.finalize(results, shutil.rmtree, self.folder, ignore_errors=True)

    def end(self, error: EvedropError | None = None) -> None:
        """Remove a temporary folder that nothing keeps; after an error, results so far stay until this program ends."""
        if not self.temporary or self._kept:
            return
        if error is not None and self.folder.is_dir() and any(self.folder.iterdir()):
            atexit.register(shutil.rmtree, self.folder, ignore_errors=True)
            error.add_note(f"Until this program ends, load_results({str(self.folder)!r}) reads the results so far.")
        else:
            shutil.rmtree(self.folder, ignore_errors=True)


@contextlib.contextmanager
def place_for(out: str | Path | None, overwrite: bool, resume: bool = False) -> Iterator[ResultsPlace]:
    """Where to write: `out`, which must be new or empty unless `overwrite`, or a temporary folder without `out`.

    resume: `out` may have an interrupted study, which goes on.

    Raises UsageError if `out` is in use and must not be overwritten, or is not a results folder.
    """
    if resume and (out is None or overwrite):
        raise UsageError(_NO_FOLDER)
    if resume and out is not None:
        place = ResultsPlace(Path(out), temporary=False)
    elif out is None:
        place = ResultsPlace(Path(tempfile.mkdtemp(prefix="evedrop-")), temporary=True)
    else:
        path_argument("out", out, "the name of a folder, or None for a temporary one")
        refuse_unless(isinstance(overwrite, bool), "overwrite", overwrite, "True or False")
        place = ResultsPlace(Path(out), temporary=False)
        _clear(place.folder, overwrite)
    try:
        yield place
    except EvedropError as error:
        place.end(error)
        if not place.temporary:
            _say_how_to_resume(error)
        raise
    except BaseException:
        place.end()
        raise
    place.end()


@contextlib.contextmanager
def place_in(out: str | Path | None, resume: bool) -> Iterator[StudyPlace | None]:
    """The place of a study that writes a folder only if `out` says so. Raises UsageError for `resume` without a folder."""
    if resume and out is None:
        raise UsageError(_NO_FOLDER)
    try:
        yield None if out is None else StudyPlace(Path(out), resume)
    except EvedropError as error:
        _say_how_to_resume(error)
        raise


def _say_how_to_resume(error: EvedropError) -> None:
    if error.resumable is not None:
        error.add_note(f"The same call with out={error.resumable!r} and resume=True goes on where it stopped.")


def _clear(folder: Path, overwrite: bool) -> None:
    """Empty a results folder that may be overwritten."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not overwrite:
        raise UsageError(f"{folder} is not empty; give another out, or overwrite=True to replace the results in it")
    if not any((folder / name).exists() for name in _OF_RESULTS):
        raise UsageError(f"{folder} is not a results folder, and overwrite=True replaces only those; give another out")
    if goes_on(folder):
        raise UsageError(f"{folder} belongs to a run in progress; wait for its end, or give another out")
    for inside in folder.iterdir():
        if inside.is_dir() and not inside.is_symlink():
            shutil.rmtree(inside)
        else:
            inside.unlink()
