"""Studies that combine all their trials at the end, with nothing to show before: the trials in parts, and all their results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, final

from evedrop.errors import Interrupted
from evedrop.results.folder import disk_errors, replace_private
from evedrop.results.summary_file import plain
from evedrop.scenario.tables import Scenario
from evedrop.simulate.finished_tasks import FinishedTasks, finished_tasks, study_of
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.tasks import OnProgress, R, Task
from evedrop.system.signals import stop_on_signals

T = TypeVar("T", bound=Task[Any])


def parts_of(task: Callable[[dict[str, Any], int, int], T], scenario: Scenario, side_by_side: int) -> list[T]:
    """The trials of a scenario in tasks of at most this many trials, in order."""
    end = scenario.first_trial + scenario.trials
    bounds = [*range(scenario.first_trial, end, side_by_side), end]
    tables = scenario.model_dump(mode="json")
    return [task(tables, *pair) for pair in pairwise(bounds)]


@final
@dataclass(frozen=True)
class StudyPlace:
    """The results folder of such a study."""

    folder: Path
    resume: bool = False
    """Whether to go on with the study in it, which was interrupted."""


@contextmanager
def all_results(
    tasks: Sequence[Task[R]], plan: Plan, on_progress: OnProgress, kind: str, place: StudyPlace | None = None
) -> Iterator[list[R]]:
    """The results of all tasks, in order, for a block that combines them and writes what it finds.

    on_progress: gets the trial-slots done since its last call; kind: the command; place: where finished tasks are kept until
    the block has ended, if there is a results folder.

    Raises UsageError if a scheduler does not answer or the folder cannot be used, RunError if a worker fails, Interrupted on
    Ctrl-C.
    """
    scenario = Scenario.read(tasks[0].scenario)
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        crew = stack.enter_context(plan.crew([scenario]))
        finished: FinishedTasks | None = None
        if place is not None:
            finished = stack.enter_context(finished_tasks(place.folder, study_of(kind, {}, [scenario]), place.resume))
            stack.enter_context(disk_errors(place.folder))
        with closing(crew.results(tasks, on_progress, stop.is_set, finished)) as results:
            complete = [result for result in results if result.complete]
        if len(complete) < len(tasks):
            if finished is None:
                raise Interrupted("interrupted before all trials were done; nothing was kept")
            finished.remove_unless_any()
            raise finished.interrupted("all trials were done")
        yield complete
        if finished is not None:
            finished.forget()


def write_found(place: StudyPlace | None, name: str, result: object) -> None:
    """Write what a study found to a file of its results folder, as strict JSON; nothing without a folder. Raises OSError."""
    if place is not None:
        replace_private(place.folder / name, json.dumps(plain(result), ensure_ascii=False, indent=1) + "\n")
