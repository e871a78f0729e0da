"""The energy that secrecy costs: a scenario's scheme against `plain`, over the same link, in the same trials.

A trial is run with the scenario's scheme and with `plain`, with the same noise of the plant and the same losses, and each
time also with a controller that sees the truth. Every metric is made from differences within a trial, so its standard error
is that of the mean of the trials' differences.

Source: docs/microgrid.md, what does secrecy cost in energy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import final

import numpy as np

from evedrop.errors import UsageError
from evedrop.model.process import Floats
from evedrop.scenario.application import APPLICATIONS, ControlledPlant, applications_in
from evedrop.scenario.closed_loop import controlled_plant
from evedrop.scenario.tables import Scenario
from evedrop.score.energy import Meter, energy
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Simulation
from evedrop.simulate.tasks import OnProgress, Stopped, Task
from evedrop.studies.matchups import with_encoding
from evedrop.studies.parts import StudyPlace, all_results, parts_of, write_found

_SIDE_BY_SIDE = 50  # trials
MEASURES = ("net", "total", "summed")
"""The fields of `EnergyDifference`."""


@dataclass(frozen=True)
class MeanEstimate:
    """The mean over trials of a metric."""

    mean: float
    standard_error: float
    low: float
    """The 95 % interval of the mean, by Student's t, is from here to `high`."""
    high: float

    @classmethod
    def of_trials(cls, trials: Floats) -> MeanEstimate:
        """From the metric of each trial, (R,), R ≥ 2."""
        from scipy.special import stdtrit  # noqa: PLC0415 - 0.2 s that only this needs

        mean, error = float(np.mean(trials)), float(np.std(trials, ddof=1)) / len(trials) ** 0.5
        reach = float(stdtrit(len(trials) - 1, 0.975)) * error
        return cls(mean, error, mean - reach, mean + reach)


@dataclass(frozen=True)
class SecrecyCost:
    """What a scheme costs an application."""

    scheme: str
    trials: int
    more_than_plain: Mapping[str, MeanEstimate]
    """`net_energy` and `total_energy`: that with the scheme less that with `plain`, in Wh."""
    differences: Mapping[str, Mapping[str, MeanEstimate]]
    """`scheme_from_plain`, `scheme_from_truth`, `plain_from_truth` → measure → the difference, as a fraction."""


def secrecy_cost(
    scenario: Scenario,
    on_progress: OnProgress,
    plan: Plan | None = None,
    place: StudyPlace | None = None,
    side_by_side: int = _SIDE_BY_SIDE,
) -> SecrecyCost:
    """Compare a scenario's scheme with `plain`.

    plan: where the trials are carried out, by default here; place: the folder for cost.json; side_by_side: trials that are
    simulated at once.

    Raises UsageError for a scenario without an application that has a power, or with fewer than two trials; ScenarioError if
    `plain` cannot be used with it; RunError if a worker fails, Interrupted on Ctrl-C.
    """
    loop = controlled_plant(scenario)
    if loop is None or not any(APPLICATIONS[name].has_power for name in scenario.applications):
        raise UsageError(f"{scenario.title}: {_lacking()}")
    if scenario.trials < 2:
        raise UsageError(f"--trials {scenario.trials}: expected 2 or more, so that there is a standard error")
    _pair(scenario)  # both are checked before a task begins
    tasks = parts_of(_CostTask, scenario, side_by_side)
    with all_results(tasks, plan or Plan(), on_progress, "cost", place) as parts:
        cost = _combined(scenario, loop, parts)
        write_found(place, "cost.json", asdict(cost))
    return cost


def _combined(scenario: Scenario, loop: ControlledPlant, parts: Sequence[_Part]) -> SecrecyCost:
    """The cost from the power of all trials."""
    plain, truth, plain_truth = (
        Meter.of_all(list(meters)) for meters in zip(*(part.meters for part in parts), strict=True)
    )
    more = {
        "net_energy": plain.bought - plain.sold - (plain.other_bought - plain.other_sold),
        "total_energy": plain.bought + plain.sold - (plain.other_bought + plain.other_sold),
    }
    pairs = {"scheme_from_plain": plain, "scheme_from_truth": truth, "plain_from_truth": plain_truth}
    return SecrecyCost(
        scenario.encoding.scheme,
        scenario.trials,
        {name: MeanEstimate.of_trials(1000.0 * energy(power, loop.slot_seconds)) for name, power in more.items()},
        {
            name: {measure: MeanEstimate.of_trials(getattr(meter.difference, measure)) for measure in MEASURES}
            for name, meter in pairs.items()
        },
    )


@dataclass(frozen=True)
class _Part:
    """Some trials."""

    meters: tuple[Meter, Meter, Meter]
    """The power of scheme and plain, of scheme and truth, and of plain and truth."""
    complete: bool


@final
@dataclass(frozen=True)
class _CostTask(Task[_Part]):
    """Some trials that are simulated at once, each with both schemes."""

    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> _Part:
        """Simulate the trials."""
        return _part_of(Scenario.read(self.scenario), range(self.start, self.stop), on_progress, stopped)

    def example(self) -> _Part:
        """A part of one trial without slots."""
        return _Part((Meter.zero(1), Meter.zero(1), Meter.zero(1)), complete=True)


def _part_of(scenario: Scenario, trials: range, on_progress: OnProgress, stopped: Stopped) -> _Part:
    meters = [Meter.zero(len(trials)) for _ in range(3)]
    ours, plain = (_powers(each, trials) for each in _pair(scenario))
    for (power, truth), (other, other_truth) in zip(ours, plain, strict=True):
        pairs = ((power, other), (power, truth), (other, other_truth))
        meters = [meter.then(*pair) for meter, pair in zip(meters, pairs, strict=True)]
        on_progress(power.size)
        if stopped():
            return _Part((meters[0], meters[1], meters[2]), complete=False)
    return _Part((meters[0], meters[1], meters[2]), complete=True)


def _pair(scenario: Scenario) -> tuple[Scenario, Scenario]:
    """The scenario with its own scheme, then with `plain`, both without eavesdroppers and attacks on acknowledgements."""
    ours, plain = (with_encoding(scenario, encoding) for encoding in (scenario.encoding.spec, {"scheme": "plain"}))
    return ours, plain


def _powers(scenario: Scenario, trials: range) -> Iterator[tuple[Floats, Floats]]:
    """The application's power, and that of a controller that sees the truth, in kW, (c, R) each, some slots at a time."""
    loop = controlled_plant(scenario)
    assert loop is not None  # noqa: S101 - there is a controller
    name, table = next(item for item in scenario.applications.items() if APPLICATIONS[item[0]].has_power)
    feed = APPLICATIONS[name].power(loop, table, len(trials))
    assert feed is not None  # noqa: S101 - it has a power
    for chunk in Simulation(scenario, trials).chunks():
        slots = chunk.slots
        assert slots is not None  # noqa: S101 - there are states in this mode
        applied = slots.sensor.applied
        assert applied is not None  # noqa: S101 - there is a controller
        if slots.sensor.watermark is not None:
            feed.take_monitored(slots.sensor)
        yield feed.take(slots.sensor.states, applied)


def _lacking() -> str:
    """Say that a scenario lacks an application that has a power, and name a scenario that does not."""
    able = {
        name: application for name, application in applications_in(APPLICATIONS.names).items() if application.has_power
    }
    examples = [application.example for application in able.values() if application.example is not None]
    hint = f"; try the scenario {' or '.join(examples)}" if examples else ""
    return f"there is no {' or '.join(able)} with a controller{hint}, or evedrop compare for the price of a scheme"
