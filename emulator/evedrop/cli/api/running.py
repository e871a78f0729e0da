"""The functions that simulate: a run, thousands of trials, a grid, a comparison; and the arguments that they share."""

from __future__ import annotations

import atexit
import contextlib
import math
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from evedrop.cli.api.notebook import progress, shown_when_open, view_in
from evedrop.cli.api.results import ComparisonResults, RunResults, SweepResults, study_in
from evedrop.cli.words import speaks_python
from evedrop.errors import EvedropError, UsageError
from evedrop.results.crash_proof_tables import goes_on
from evedrop.results.folder import UNFINISHED
from evedrop.scenario.arguments import CHANGES, path_argument, refuse_unless, table_argument
from evedrop.scenario.loading import plain_tables, prepared
from evedrop.scenario.progress_events import OnEvent
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import dotted
from evedrop.show.view.viewer import NOTEBOOK
from evedrop.simulate.finished_tasks import STUDY, TASKS
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.studies.parts import StudyPlace

if TYPE_CHECKING:
    from evedrop.studies.learning_curve import LearningRow
    from evedrop.studies.secrecy_cost import SecrecyCost


_Results = TypeVar("_Results", RunResults, SweepResults, ComparisonResults)

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


def results_of(
    study: Callable[[Path, OnEvent], _Results],
    out: str | Path | None,
    overwrite: bool,
    on_event: OnEvent | None,
    total: int,
    resume: bool = False,
) -> _Results:
    """The results of a study, which writes a folder and tells events: `out`, or without it a temporary folder.

    `out` must be new or empty unless `overwrite`. A temporary folder stays as long as the results exist and this program runs;
    after an error, the results so far in it stay until this program ends. on_event, total: as for `progress`; resume: `out` may
    have an interrupted study, which goes on.

    Raises UsageError if `out` is in use and must not be overwritten, or is not a results folder.
    """
    if resume and (out is None or overwrite):
        raise UsageError(_NO_FOLDER)
    earlier: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if out is None:
        folder = Path(tempfile.mkdtemp(prefix="evedrop-"))
    else:
        path_argument("out", out, "the name of a folder, or None for a temporary one")
        refuse_unless(isinstance(overwrite, bool), "overwrite", overwrite, "True or False")
        folder = Path(out)
        if not resume:
            earlier = _set_aside(folder, overwrite)
    kept = out is not None
    try:
        with earlier, progress(on_event, total) as emit:
            results = study(folder, emit)
        if not kept:
            weakref.finalize(results, shutil.rmtree, folder, ignore_errors=True)
            kept = True
        return results
    except EvedropError as error:
        if out is not None:
            _say_how_to_resume(error)
        elif folder.is_dir() and any(folder.iterdir()):
            kept = True
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            error.add_note(f"Until this program ends, load_results({str(folder)!r}) reads the results so far.")
        raise
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def place_in(out: str | Path | None, resume: bool) -> Iterator[StudyPlace | None]:
    """The place of a study that writes a folder only if `out` says so. Raises UsageError for `resume` without a folder."""
    if resume and out is None:
        raise UsageError(_NO_FOLDER)
    if out is not None:
        path_argument("out", out, "the name of a folder, or None for none")
    try:
        yield None if out is None else StudyPlace(Path(out), resume)
    except EvedropError as error:
        _say_how_to_resume(error)
        raise


def _say_how_to_resume(error: EvedropError) -> None:
    if error.resumable is not None:
        error.add_note(f"The same call with out={error.resumable!r} and resume=True goes on where it stopped.")


def _has_results(folder: Path) -> bool:
    """Whether a folder has what only Evedrop writes: files of other programs are called summary.json, too."""
    if (folder / TASKS / STUDY).is_file():
        return True
    if (folder / "scenario.toml").is_file() and any((folder / name).is_dir() for name in (UNFINISHED, "shards")):
        return True
    try:
        study_in(folder)
    except UsageError:
        return False
    return True


@contextlib.contextmanager
def _set_aside(folder: Path, overwrite: bool) -> Iterator[None]:
    """Empty a results folder that may be overwritten, for the block; if the block leaves nothing there, all of it comes back."""
    if not folder.is_dir() or not any(folder.iterdir()):
        yield
        return
    if not overwrite:
        raise UsageError(f"{folder} is not empty; give another out, or overwrite=True to replace the results in it")
    if goes_on(folder):
        raise UsageError(f"{folder} belongs to a run in progress; wait for its end, or give another out")
    if not _has_results(folder):
        raise UsageError(f"{folder} is not a results folder, and overwrite=True replaces only those; give another out")
    place = folder.resolve()
    try:
        aside = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))  # on the same disk
        try:
            _move_all(place, aside)
        except OSError:  # no right, or the folder is a disk of its own
            _move_all(aside, place)
            aside.rmdir()
            raise
    except OSError as error:
        raise UsageError(f"{folder}: its results cannot be set aside ({error.strerror}); give another out") from error
    try:
        yield
    finally:
        if place.is_dir() and any(place.iterdir()):
            shutil.rmtree(aside)
        else:
            place.mkdir(mode=0o700, exist_ok=True)
            _move_all(aside, place)
            aside.rmdir()


def _move_all(folder: Path, to: Path) -> None:
    for inside in [*folder.iterdir()]:
        inside.rename(to / inside.name)


@speaks_python
def run(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    overwrite: bool = False,
    view: str = "off",
    listen: str | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> RunResults:
    """Run a scenario live, with sensor, router, estimators and recorder in separate processes.

    scenario: a built-in name, a file, or a `Scenario`; out: the results folder, new or empty, by default a temporary one that is
    removed with the results; overwrite: replace the results in `out`; view: notebook (in the cell, where it stays until the
    kernel ends), native (a window), web (a page, whose address is printed), auto (one of these) or off; listen: the router's
    loopback endpoint, tls/127.0.0.1:PORT, by default a socket; on_event: called with each event, by default a progress bar
    in a notebook; changes: entries of the scenario by dotted key, with `__` for the dot, such as `slots=500` or
    `legitimate__link__quality=0.5`.

    Raises ScenarioError with every mistake of the scenario, UsageError for an unusable folder or port, RunError if a
    process failed, Interrupted on Ctrl-C; after the last two the folder holds the results so far.

    >>> results = run("eavesdroppers", slots=1000, out="my-run")        # doctest: +SKIP
    >>> results.peers["smart"].mean_squared_error                       # doctest: +SKIP
    >>> results.slots.to_pandas()                                       # doctest: +SKIP
    """
    from evedrop.live.launch.launcher import launch  # Monte Carlo does not need it

    made, view = scenario_of(scenario, changes), view_in(view)
    refuse_unless(
        listen is None or isinstance(listen, str), "listen", listen, "an endpoint such as tls/127.0.0.1:17460"
    )

    def launched(folder: Path, emit: OnEvent) -> RunResults:
        ended = launch(made, folder, view, listen, shown_when_open(view, emit))
        if ended.viewer is not None and view != NOTEBOOK:
            ended.viewer.stop()
        return RunResults.read(ended.folder)

    return results_of(launched, out, overwrite, on_event, made.slots)


@speaks_python
def montecarlo(
    scenario: str | Path | Scenario,
    *,
    trials: int = 1000,
    out: str | Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    plan: Plan | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> RunResults:
    """Run the trials of a scenario in memory; in the exact mode, the default, to the same bits as a live run.

    Arguments and errors as for `run`; trials: how many, from `first_trial` on; resume: go on with the study in `out` if it was
    interrupted, and begin it otherwise; workers: processes, by default chosen for this
    machine and the amount of work; scheduler: the address of a Dask scheduler, such as "tcp://127.0.0.1:8786", whose workers
    then compute the trials; plan: the mode.
    """
    from evedrop.simulate.montecarlo import simulate  # a live run does not need it

    plan = plan_of(plan, workers, scheduler)
    made = scenario_of(scenario, {**changes, "trials": trials}, plan.mode is not Mode.EXACT)

    def simulated(folder: Path, emit: OnEvent) -> RunResults:
        simulate(made, folder, emit, plan, resume=resume)
        return RunResults.read(folder)

    return results_of(simulated, out, overwrite, on_event, made.trials * made.slots, resume)


@speaks_python
def sweep(
    scenario: str | Path | Scenario,
    over: Mapping[str, Any],
    *,
    trials: int = 1000,
    out: str | Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    plan: Plan | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> SweepResults:
    """Run the trials of a scenario in memory for every combination of values of some entries.

    over: dotted key → its values, a list or a numpy array; all else as for `montecarlo`. Source: docs/montecarlo.md, sweeps.

    Raises ScenarioError with the mistakes of all points, before any is run; UsageError, RunError and Interrupted as `run` does.

    >>> sweep("numerical", {"encoding.state_probability": [0.4, 0.6, 0.8]}, trials=200).table.to_pandas()  # doctest: +SKIP
    """
    from evedrop.studies.sweep import MOST_POINTS, sweep_over  # no other call needs it

    given = {**dotted(changes), "trials": trials}
    wanted = 'a dict of lists by dotted key, such as {"encoding.state_probability": [0.2, 0.4]}'
    refuse_unless(over is not None, "over", over, wanted)
    values = _named(dotted(table_argument("over", over, wanted)), "over", scenario, given)
    for key, chosen in values.items():
        if not isinstance(chosen, list) or not chosen:
            raise UsageError(f"over: {key} is {chosen!r}; expected a list of values, such as [0.2, 0.4]")
    if not values or math.prod(map(len, values.values())) > MOST_POINTS:
        raise UsageError(f"over: expected 1 to {MOST_POINTS} points, such as {{'slots': [100, 200]}}")

    def swept(folder: Path, emit: OnEvent) -> SweepResults:
        table = sweep_over(scenario, given, values, folder, emit, plan_of(plan, workers, scheduler), resume=resume)
        return SweepResults(folder, table, tuple(values))

    return results_of(swept, out, overwrite, on_event, 0, resume)


@speaks_python
def compare(
    scenario: str | Path | Scenario,
    *,
    schemes: Sequence[str | type] | None = None,
    adversaries: Sequence[str | type] | None = None,
    parameters: Mapping[str, Any] | None = None,
    trials: int = 200,
    out: str | Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    plan: Plan | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> ComparisonResults:
    """Compare schemes against adversaries, on a scenario's process and links.

    schemes, adversaries: names or classes, by default all; parameters: of schemes other than the scenario's own, such as
    `{"innovation.state_probability": 0.7}`; all else as for `montecarlo`. Source: docs/compare.md.

    Raises UsageError with every unknown name, ScenarioError with every mistake of the scenario, RunError if a worker
    fails, Interrupted on Ctrl-C; after the last two the folder holds the completed schemes.

    >>> found = compare("acknowledged", schemes=["acknowledged", "innovation"])        # doctest: +SKIP
    >>> found.cell("acknowledged", "blocks-critical").eavesdropper.theory.last         # doctest: +SKIP
    >>> found.table.to_pandas()                                                        # doctest: +SKIP
    """
    from evedrop.studies.compare import compare_all  # no other call needs it
    from evedrop.studies.matchups import matchups_of  # the same

    given = {**dotted(changes), "trials": trials}
    for name, names in (("schemes", schemes), ("adversaries", adversaries)):
        fits = names is None or (isinstance(names, Iterable) and not isinstance(names, str))
        refuse_unless(fits, name, names, "a list of names or classes")
    table_argument("parameters", parameters, 'a dict such as {"innovation.state_probability": 0.7}')
    asked = {"schemes": schemes, "adversaries": adversaries, "parameters": parameters}
    chosen = _named(asked, "compare", scenario, given)
    made = scenario_of(scenario, given)
    matchups = matchups_of(made, chosen.get("schemes"), chosen.get("adversaries"), chosen.get("parameters"))

    def compared(folder: Path, emit: OnEvent) -> ComparisonResults:
        comparison = compare_all(matchups, folder, emit, plan_of(plan, workers, scheduler), resume=resume)
        return ComparisonResults.of(comparison, folder)

    return results_of(compared, out, overwrite, on_event, 0, resume)


@speaks_python
def cost(
    scenario: str | Path | Scenario,
    *,
    trials: int = 100,
    out: str | Path | None = None,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> SecrecyCost:
    """The energy that secrecy costs an application: the scenario's scheme against `plain`, trial by trial.

    Arguments as for `montecarlo`; out: by default no folder, otherwise one for cost.json, in which finished trials are kept for
    `resume`. Source: docs/microgrid.md, what does secrecy cost in energy.

    Raises ScenarioError with every mistake of the scenario, UsageError without an application that has a power, RunError if a
    worker fails, Interrupted on Ctrl-C.
    """
    from evedrop.simulate.montecarlo import progress_counter  # a live run does not need it
    from evedrop.studies.secrecy_cost import secrecy_cost  # no other call needs it

    made = scenario_of(scenario, {**changes, "trials": trials})
    with place_in(out, resume) as place, progress(on_event, total := made.trials * made.slots) as emit:
        return secrecy_cost(made, progress_counter(emit, total), plan_of(None, workers, scheduler), place)


@speaks_python
def learned(
    scenario: str | Path | Scenario,
    *,
    trials: int = 100,
    out: str | Path | None = None,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    on_event: OnEvent | None = None,
    **changes: Any,
) -> list[LearningRow]:
    """What eavesdroppers that learn know of the process after 8, 16, 32, … slots, and how that affects their error.

    Arguments as for `montecarlo`; out: by default no folder, otherwise one for learned.json, in which finished trials are kept
    for `resume`. Source: docs/learning.md.

    Raises ScenarioError with every mistake of the scenario, UsageError if no eavesdropper learns, RunError if a worker fails,
    Interrupted on Ctrl-C.
    """
    from evedrop.simulate.montecarlo import progress_counter  # a live run does not need it
    from evedrop.studies.learning_curve import learning_curve  # no other call needs it

    made = scenario_of(scenario, {**changes, "trials": trials})
    with place_in(out, resume) as place, progress(on_event, total := made.trials * made.slots) as emit:
        return learning_curve(made, progress_counter(emit, total), plan_of(None, workers, scheduler), place)


def _named(
    values: Mapping[str, Any], source: str, scenario: str | Path | Scenario, given: dict[str, Any]
) -> dict[str, Any]:
    """The values as plain tables, with the names of classes. The folder of their modules is added to the changes `given`."""
    modules = given.get("modules", scenario.modules if isinstance(scenario, Scenario) else None)
    tables = plain_tables(values, source, modules)
    if isinstance(tables.get("modules"), str):
        given["modules"] = tables.pop("modules")
    return tables
