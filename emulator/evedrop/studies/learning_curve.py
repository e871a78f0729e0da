"""How much learning eavesdroppers know of the process by a slot, and how that affects their error.

All eavesdroppers hear the same trials, so the errors of two of them are compared trial by trial.

Source: docs/learning.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import final

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.metrics.standard_error import ratio_error, standard_error
from evedrop.model.process import Floats
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Simulation
from evedrop.simulate.tasks import OnProgress, Stopped, Task
from evedrop.studies.parts import StudyPlace, all_results, parts_of, write_found

_SIDE_BY_SIDE = 100  # trials
_FIRST = 8  # slots before the first row


@dataclass(frozen=True)
class ParameterError:
    """How far an estimate is from the truth, over the truth, by the Frobenius norm."""

    median: float
    """Over trials."""
    mean: float
    standard_error: float | None
    """The standard error of the mean."""


@dataclass(frozen=True)
class ErrorRatio:
    """The mean squared error of one receiver over that of another one, in the same trials."""

    ratio: float
    standard_error: float | None


@dataclass(frozen=True)
class LearningRow:
    """What is known after some slots."""

    first: int
    """Errors are those of the slots from here on."""
    stop: int
    """The number of slots so far."""
    parameters: Mapping[str, Mapping[str, ParameterError]]
    """Learner → `A`, `Q` and `mu_d` → the error of its estimate after these slots."""
    errors: Mapping[str, float]
    """Receiver → its mean squared error."""
    standard_errors: Mapping[str, float | None]
    """Receiver → the standard error of that."""
    ratios: Mapping[str, Mapping[str, ErrorRatio]]
    """Learner → every other receiver → the learner's mean squared error over the other's."""


def learning_curve(
    scenario: Scenario,
    on_progress: OnProgress,
    plan: Plan | None = None,
    place: StudyPlace | None = None,
    side_by_side: int = _SIDE_BY_SIDE,
) -> list[LearningRow]:
    """A row for every power of two from 8 slots on, and for the whole run.

    plan: where the trials are carried out, by default here; place: the folder for learned.json; side_by_side: trials that are
    simulated at once.

    Raises UsageError for a scenario in which no eavesdropper learns, RunError if a worker fails, Interrupted on Ctrl-C.
    """
    windows = _windows(scenario)
    first = Simulation(scenario, range(scenario.first_trial, scenario.first_trial + 1), stops=[1])
    next(first.chunks())
    if not first.learned():
        raise UsageError(f"{scenario.title}: no eavesdropper learns; try the scenario learning")
    tasks = parts_of(_LearningTask, scenario, side_by_side)
    with all_results(tasks, plan or Plan(), on_progress, "learned", place) as parts:
        rows = [_row(window, [part.windows[i] for part in parts]) for i, window in enumerate(windows)]
        write_found(place, "learned.json", [asdict(row) for row in rows])
    return rows


def _windows(scenario: Scenario) -> list[tuple[int, int]]:
    """The slots of each row, first and stop."""
    stops = [_FIRST]
    while 2 * stops[-1] < scenario.slots:
        stops.append(2 * stops[-1])
    stops = [*(stop for stop in stops if stop < scenario.slots), scenario.slots]
    return [*pairwise([0, *stops])]


@dataclass(frozen=True)
class _Measured:
    """A window of some trials, (R,) each."""

    off: Mapping[str, Mapping[str, Floats]]
    """Learner → parameter → relative error."""
    error: Mapping[str, Floats]
    """Receiver → mean squared error."""


@dataclass(frozen=True)
class _Part:
    """All windows of some trials."""

    windows: list[_Measured]
    complete: bool


@final
@dataclass(frozen=True)
class _LearningTask(Task[_Part]):
    """Some trials that are simulated at once."""

    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> _Part:
        """Simulate the trials. Raises UsageError if no eavesdropper learns."""
        scenario = Scenario.read(self.scenario)
        windows = _windows(scenario)
        measured = _measured(scenario, range(self.start, self.stop), windows, on_progress, stopped)
        return _Part(measured, len(measured) == len(windows))

    def example(self) -> _Part:
        """A part with one window, of no receivers."""
        return _Part([_Measured({}, {})], complete=True)


def _measured(
    scenario: Scenario, trials: range, windows: list[tuple[int, int]], on_progress: OnProgress, stopped: Stopped
) -> list[_Measured]:
    """The windows of these trials, fewer after a stop."""
    simulation = Simulation(scenario, trials, stops=[stop for _, stop in windows])
    process = scenario.process.process
    truth = {"A": process.A, "Q": process.Q, "mu_d": np.array(scenario.encoding.mu_d)}
    measured: list[_Measured] = []
    sums: dict[str, Floats] = {}
    for chunk in simulation.chunks():
        count = 0
        for name, receiver in chunk.receivers.items():
            count = len(receiver.error)
            sums[name] = _added(receiver.error, sums.get(name, np.zeros(len(trials))))
        first, stop = windows[len(measured)]
        if chunk.first + count == stop:
            off = {
                name: {key: _relative(values, truth[key]) for key, values in receiver.items()}
                for name, receiver in simulation.learned().items()
            }
            measured.append(_Measured(off, {name: total / (stop - first) for name, total in sums.items()}))
            sums = {}
        on_progress(count * len(trials))
        if stopped():
            break
    return measured


def _relative(estimates: Floats, truth: Floats) -> Floats:
    """|found − truth| / |truth| of every trial: found (…, R) → (R,)."""
    away = (estimates - truth[..., None]) ** 2
    off: Floats = np.sqrt(_added(away.reshape(-1, estimates.shape[-1]), np.zeros(estimates.shape[-1])))
    return off / float(np.linalg.norm(truth))


def _added(rows: Floats, total: Floats) -> Floats:
    """The total (R,) and all rows (c, R), one after the other: numpy's order depends on the number of trials."""
    for row in rows:
        total = total + row
    return total


@np.errstate(divide="ignore", invalid="ignore")  # an error, or a parameter, that is 0
def _row(window: tuple[int, int], parts: list[_Measured]) -> LearningRow:
    error = {name: np.concatenate([part.error[name] for part in parts]) for name in parts[0].error}
    return LearningRow(
        *window,
        {
            learner: {key: _summarised(np.concatenate([part.off[learner][key] for part in parts])) for key in values}
            for learner, values in parts[0].off.items()
        },
        {name: float(np.mean(of)) for name, of in error.items()},
        {name: standard_error(of) for name, of in error.items()},
        {
            learner: {
                name: ErrorRatio(float(np.mean(error[learner]) / np.mean(of)), ratio_error(error[learner], of))
                for name, of in error.items()
                if name not in {learner, LEGITIMATE}
            }
            for learner in parts[0].off
        },
    )


def _summarised(off: Floats) -> ParameterError:
    return ParameterError(float(np.median(off)), float(np.mean(off)), standard_error(off))
