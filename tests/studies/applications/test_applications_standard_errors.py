"""Standard errors of closed loops, detections and applications: those of runs of one trial, put together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from evedrop.cli.api import montecarlo
from evedrop.scenario.application import APPLICATIONS, STANDARD_ERRORS, ApplicationTally
from evedrop.scenario.loading import load
from evedrop.score.closed_loop_tally import LoopTally
from evedrop.score.links import Detection
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of
from evedrop.studies.sweep import sweep_over
from tests.examples import mostly_long

ALONE = Plan(workers=1)
TRIALS = 4


def studies(scenario: str, tmp_path: Path, **changes: Any) -> tuple[Mapping[str, Any], list[Mapping[str, Any]]]:
    """The summary of four trials, and those of each of them alone."""
    some: dict[str, Any] = {"expect": [], "plan": ALONE, **changes}
    together = montecarlo(scenario, trials=TRIALS, out=tmp_path / "together", **some).summary
    alone = [
        montecarlo(scenario, trials=1, first_trial=trial, out=tmp_path / str(trial), **some).summary
        for trial in range(TRIALS)
    ]
    return together, alone


def leaves(entries: Mapping[str, Any], place: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """Place → value, for all values of nested entries."""
    whole: dict[tuple[str, ...], Any] = {}
    for name, value in entries.items():
        whole |= leaves(value, (*place, name)) if isinstance(value, Mapping) else {(*place, name): value}
    return whole


def check(together: Mapping[str, Any], alone: list[Mapping[str, Any]], ignored: tuple[str, ...] = ()) -> None:
    """Each standard error is that of the values of the single trials; every metric that differs has one."""
    errors = leaves(together[STANDARD_ERRORS])
    singles = [leaves({name: value for name, value in entries.items() if name != STANDARD_ERRORS}) for entries in alone]
    differ = {
        place for place in singles[0] if len({single[place] for single in singles}) > 1 and place[0] not in ignored
    }
    assert differ
    assert differ <= set(errors)
    for place, error in errors.items():
        values = np.array([single[place] for single in singles], dtype=object)
        if any(value is None for value in values):
            assert error is None
            continue
        assert error == pytest.approx(np.std(values.astype(float), ddof=1) / math.sqrt(TRIALS), rel=1e-9), place


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("scenario", "application"),
    mostly_long([("heated-room", "comfort"), ("microgrid", "household")], [("heated-room", "comfort")]),
)
def test_applications_have_the_standard_errors_of_single_trials(
    scenario: str, application: str, tmp_path: Path
) -> None:
    """And so do their closed loops; an error that is not the model's has no z."""
    together, alone = studies(scenario, tmp_path, slots=600)
    check(together[application], [entries[application] for entries in alone], ("windows", "active_windows"))
    timed = ("mean_solve_seconds", "longest_solve_seconds", "digest")
    check(together["controller"], [entry["controller"] for entry in alone], timed)
    assert all(set(peer["z"].values()) == {None} and peer["rare_events"] is None for peer in together["peers"].values())
    assert leaves(alone[0][application][STANDARD_ERRORS])
    assert {*leaves(alone[0][application][STANDARD_ERRORS]).values()} == {None}


def test_a_delay_has_the_standard_error_of_its_alarms() -> None:
    """It is computed over the trials that raised an alarm in time; a single alarm gives no standard error."""
    scenario = load("acknowledged", {"trials": 4})
    detection = Detection(4)
    detection.first[:] = 10, 14, -1, 18
    summary = detection.summary(scenario)
    assert summary is not None
    assert summary.mean_delay == 15.0
    assert summary.standard_errors == {"mean_delay": pytest.approx(4.0 / math.sqrt(3.0))}
    detection.first[1:] = -1
    summary = detection.summary(scenario)
    assert summary is not None
    assert summary.standard_errors == {"mean_delay": None}


@pytest.mark.long
def test_a_sweep_has_the_standard_errors_of_an_application(tmp_path: Path) -> None:
    """In columns of their own; pictures are drawn with them."""
    changes: dict[str, Any] = {"trials": 3, "slots": 200, "expect": []}
    table: pa.Table = sweep_over("heated-room", changes, {"seed": [1]}, tmp_path / "swept", lambda _: None, ALONE)
    summary = montecarlo("heated-room", **changes, seed=1, out=tmp_path / "alone", plan=ALONE).summary["comfort"]
    for row in table.to_pylist():
        assert row["heating_energy_standard_error"] == summary[STANDARD_ERRORS]["heating_energy"]
        error = summary[STANDARD_ERRORS]["receivers"][row["peer"]]["known_fraction"]
        assert row["known_fraction_standard_error"] == error


@pytest.mark.parametrize(
    ("name", "application", "total"),
    [("heated-room", "comfort", "heating_energy"), ("microgrid", "household", "bought_energy")],
)
def test_trials_of_different_lengths_have_no_common_total(name: str, application: str, total: str) -> None:
    """A shard, or a block of trials, that was cut short would make the mean of the energies smaller."""
    tallies = []
    for slots in (60, 60, 30):
        (task,) = tasks_of(load(name, {"slots": slots, "trials": 2, "expect": []}), Mode.EXACT, 1)
        tallies.append(task.carry_out(lambda _: None, lambda: False).blocks[0].run_tally.loop)
    whole, cut_short = LoopTally.merged(tallies[:2]), LoopTally.merged(tallies)
    assert whole is not None
    assert cut_short is not None
    entry = whole.entries(4)[application]
    assert entry[total] is not None
    assert len(APPLICATIONS[application].lines(entry)) >= 2
    entry = cut_short.entries(6)[application]
    assert entry[total] is None
    assert "kWh" not in " ".join(APPLICATIONS[application].lines(entry))


def test_an_application_without_trials_has_no_standard_errors() -> None:
    """Its entry is its summary; its metrics have no error in the report."""

    class Plain(ApplicationTally):
        def add(self, x: Any, u: Any, estimates: Any) -> None:
            raise NotImplementedError

        @classmethod
        def merged(cls, parts: Any) -> Any:
            raise NotImplementedError

        def summary(self) -> dict[str, Any]:
            return {"heating_energy": 2.0}

    entry = Plain().entry()
    assert entry == {"heating_energy": 2.0}
    assert APPLICATIONS["comfort"].standard_error(entry, ("heating_energy",)) is None
    assert APPLICATIONS["comfort"].text(entry, ("heating_energy",)) == "2"


HEAVY: dict[str, Any] = {
    "process.A": [[1.3, 0.1], [0.0, 0.9]],
    "encoding.state_probability": 0.2,
    "legitimate.link.quality": 0.7,
}


@pytest.mark.parametrize("scenario", ["measured", "heated-room"])
def test_errors_of_infinite_variance_have_no_standard_errors_in_filter_and_controller_either(
    scenario: str, tmp_path: Path
) -> None:
    """Against the true state, and of the estimator that is not in the loop; the filter's own error has one."""
    summary = montecarlo(scenario, slots=20, trials=10, expect=[], plan=ALONE, out=tmp_path / "it", **HEAVY).summary
    assert summary["peers"]["legitimate"]["infinite_variance"]
    if scenario == "measured":
        errors = summary["filter"][STANDARD_ERRORS]
        assert errors["mean_squared_error"] > 0.0
        heavy = {name for name, peer in summary["peers"].items() if peer["infinite_variance"]}
        assert {name for name, error in errors["mean_true_squared_errors"].items() if error is None} == heavy
    else:
        errors = summary["controller"][STANDARD_ERRORS]
        assert set(errors["mean_squared_errors"].values()) == {None}
        assert all(error is not None for error in summary["controller"]["mean_squared_errors"].values())
