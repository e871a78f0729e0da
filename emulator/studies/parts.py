"""Studies that combine all their trials at the end, with nothing to show before: the trials in parts, and all their results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import pairwise
from typing import Any, TypeVar

from evedrop.errors import Interrupted
from evedrop.memory.montecarlo import Plan
from evedrop.memory.tasks import R, Task, Tell
from evedrop.scenario import Scenario
from evedrop.signals import stop_on_signals

T = TypeVar("T", bound=Task[Any])


def parts_of(task: Callable[[dict[str, Any], int, int], T], scenario: Scenario, side_by_side: int) -> list[T]:
    """The trials of a scenario in tasks of at most this many trials, in order."""
    end = scenario.first_trial + scenario.trials
    bounds = [*range(scenario.first_trial, end, side_by_side), end]
    tables = scenario.model_dump(mode="json")
    return [task(tables, *pair) for pair in pairwise(bounds)]


def all_results(tasks: Sequence[Task[R]], plan: Plan, tell: Tell) -> list[R]:
    """The results of all tasks, in order; tell: gets the trial-slots done since its last call.

    Raises UsageError if a scheduler does not answer, RunError if a worker fails, Interrupted on Ctrl-C.
    """
    with (
        stop_on_signals() as stop,
        plan.crew([Scenario.read(tasks[0].scenario)]) as crew,
        closing(crew.results(tasks, tell, stop.is_set)) as results,
    ):
        found = [result for result in results if result.complete]
    if len(found) < len(tasks):
        raise Interrupted("interrupted before all trials were done; nothing was kept")
    return found
