"""The closed loop in a run: in memory here, and live."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import tomli_w

from evedrop.cli.api import compare, montecarlo, run, sweep
from evedrop.cli.api.results import RunResults
from evedrop.errors import UsageError
from evedrop.model.metrics.standard_error import ratio_error, z_of
from evedrop.results.comparison import read_comparison
from evedrop.results.diff import difference
from evedrop.results.reading import Results
from evedrop.results.shard_score import packed, unpacked
from evedrop.scenario.loading import checked, load
from evedrop.scenario.progress_events import silent
from evedrop.score.after_start import ratio_interval
from evedrop.score.filtering import FilterTally
from evedrop.score.verdict import times_text
from evedrop.show.report import closing
from evedrop.show.report.closing import sweep_table
from evedrop.show.report.comparison import comparison_heading
from evedrop.show.view.scene_slots import replay
from evedrop.simulate.montecarlo import Plan, simulate
from evedrop.simulate.simulation import Mode
from tests.builders import changed, digests_of
from tests.conftest import Evedrop
from tests.show.view.read_back import rows

TITLE = "A tank that is steered over a lossy network"


DRAUGHT = {
    "disturbances": ["draught"],
    "disturbance_matrix": [[-0.05], [0.0]],
    "disturbance_values": (np.random.default_rng(4).random((300, 1)) - 0.5).tolist(),
}


CALM = dict.fromkeys((f"plant__{name}" for name in DRAUGHT), None)
"""No draught, for as many slots as one likes."""


TANK: dict[str, Any] = {
    "title": TITLE,
    "slots": 300,
    "seed": 5,
    "trials": 6,
    "record_trials": 2,
    "process": {
        "A": [[1.0, 0.0], [0.05, 1.0]],
        "Q": [[1e-4, 0.0], [0.0, 1e-4]],
        "initial_covariance": [[0.01, 0.0], [0.0, 0.01]],
        "reference": [55.0, 50.0],
    },
    "plant": {
        "inputs": ["heater"],
        "input_matrix": [[0.1], [0.0]],
        "input_lower": [-2.0],
        "input_upper": [2.0],
        **DRAUGHT,
        "noise": [[1e-6, 0.0], [0.0, 0.0]],
        "start": [54.0, 50.5],
    },
    "controller": {
        "strategy": "lqr",
        "state_weights": [1.0, 1.0],
        "input_weights": [0.1],
    },
    "encoding": {"scheme": "innovation", "state_probability": 0.3},
    "legitimate": {"link": {"quality": 0.6}},
    "eavesdroppers": {
        "smart": {"strategy": "smart", "link": {"quality": 0.6}},
        "naive": {"strategy": "naive", "link": {"quality": 0.6}},
    },
}
"""A marginal plant with a disturbance, a regulator and two eavesdroppers."""


def in_memory(folder: Path, plan: Plan | None = None, **changes: Any) -> Results:
    """Its results."""
    simulate(checked(changed(TANK, **changes), "file"), folder, silent, plan or Plan(workers=1))
    return Results.read(folder)


def digests(results: Results) -> dict[str, str]:
    """Of all receivers, and of the controller."""
    return {**digests_of(results), "controller": results.summary["controller"]["digest"]}


def column(table: pa.Table | None, name: str, **where: Any) -> np.ndarray:
    """The values of one column, in the rows in which others have the values that are given."""
    assert table is not None
    for other, value in where.items():
        table = table.filter(pc.equal(table[other], value))
    return np.array(table[name].to_pylist())


def test_the_loop_is_closed_over_the_estimate(tmp_path: Path) -> None:
    """The tables tell the same story: every state follows from the one before, and every input from the estimate."""
    results = in_memory(tmp_path / "run")
    x, x_hat = (column(results.trials, name, peer="legitimate", trial=1) - [55.0, 50.0] for name in ("x", "x_hat"))
    assert results.inputs is not None
    assert results.inputs.schema.names == ["slot", "trial", "u", "d", "failed", "clipped"]
    u, d = (column(results.inputs, name, trial=1) for name in ("u", "d"))
    plant = checked(changed(TANK), "file").plant
    assert plant is not None
    assert plant.disturbance_values is not None
    assert np.array_equal(d, plant.disturbance_values)
    moved = x[:-1] @ np.array([[1.0, 0.05], [0.0, 1.0]]) + u[:-1] * [0.1, 0.0] + d[:-1] * [-0.05, 0.0]
    assert np.allclose(x[1:, 1], moved[:, 1], atol=1e-10)
    assert 3e-4 < (x[1:, 0] - moved[:, 0]).std() < 3e-3
    gain = np.linalg.lstsq(x_hat[abs(u[:, 0]) < 2.0], u[abs(u[:, 0]) < 2.0], rcond=None)
    assert gain[1].item() < 1e-18, "the input is a linear function of the estimate"
    assert abs(x[200:].mean(axis=0)).max() < 0.5, "and keeps the states where they should be"
    summary = results.summary["controller"]
    assert summary["decisions"] == 300
    assert summary["failed_fraction"] == 0.0
    assert summary["clipped_fraction"] == 0.0


LIVE: dict[str, dict[str, Any]] = {
    "one trial": {"trials": 1, "record_trials": 1, "legitimate__knows_input": True},
    "twenty trials": {"trials": 20, "controller__period": 3, "controller__rate_limits": [0.2]},
    "the truth": {"trials": 2, "controller__acts_on": "truth", "event": [{"from": 50, "to": 90, "kill": "legitimate"}]},
    "late and held": {
        "trials": 3,
        "legitimate__knows_input": True,
        "legitimate__window": 3,
        "legitimate__link": {"quality": 0.8, "delay": {"model": "normal", "mean": 1.0, "standard_deviation": 1.0}},
        "event": [{"from": 101, "to": 120, "cut": "legitimate"}, {"from": 150, "to": 160, "kill": "smart"}],
    },
}

MEASURED: dict[str, Any] = {
    "process__Q": "filter",
    "plant__output_matrix": [[1.0, 0.0], [0.0, 1.0]],
    "plant__measurement_noise": [[0.01, 0.0], [0.0, 0.01]],
    "plant__noise": [[1e-3, 0.0], [0.0, 1e-3]],
}
LIVE["filtered"] = {"trials": 2, **MEASURED}
LIVE["filtered and betrayed"] = {
    "trials": 2,
    **MEASURED,
    "eavesdroppers__smart": {
        "strategy": "replay-informed",
        "learns_at": 40,
        "reads_as": "smart",
        "link": {"quality": 0.8},
    },
}


def test_errors_against_the_true_state_are_given_beside_those_of_the_transmitted(tmp_path: Path) -> None:
    """They add up, for x − x̂ˢ is orthogonal to all that anybody is told; the filter's error is its covariance's."""
    summary = in_memory(tmp_path / "run", trials=400, **MEASURED).summary
    summary_ = summary["filter"]
    assert summary_["mean_squared_error"] == pytest.approx(summary_["mean_trace_covariance"], rel=0.03)
    for name in ("legitimate", "smart"):
        transmitted = summary["peers"][name]["mean_squared_error"]
        both = transmitted + summary_["mean_squared_error"]
        assert summary_["mean_true_squared_errors"][name] == pytest.approx(both, rel=0.03)
        assert summary_["mean_true_squared_errors"][name] > transmitted


def test_a_legitimate_error_of_0_has_no_true_ratio() -> None:
    """Of a sensor that measures exactly, over a perfect link: the run ended in a division by zero, and had no results."""
    exact = {"output_matrix": [[1.0]], "measurement_noise": [[0.0]], "noise": [[0.1]]}
    scenario = {
        "title": "Exact", "slots": 40, "seed": 15, "encoding": {"scheme": "plain"}, "plant": exact,
        "process": {"A": [[0.5]], "Q": [[0.1]], "initial_covariance": [[0.1]]}, "legitimate": {"link": {"quality": 1.0}},
        "eavesdroppers": {"deaf": {"strategy": "naive", "link": {"quality": 0.8}},
                          "next_door": {"strategy": "naive", "link": {"quality": 1.0}}},
    }  # fmt: skip
    summary = montecarlo(checked(scenario, "file"), trials=5, plan=Plan(workers=1)).summary
    assert (
        summary["filter"]["mean_true_squared_errors"]["legitimate"]
        == 0.0
        < summary["peers"]["deaf"]["mean_squared_error"]
    )
    ratios = summary["filter"]["true_ratios"]
    assert "deaf" not in ratios
    assert ratios["next_door"]["ratio"] == 1.0
    assert summary["verdict"]["eavesdropper"] == "next_door"


def test_a_verdict_says_what_errors_are_measured_against(tmp_path: Path) -> None:
    """Its ratio is against the transmitted estimate; that against the truth is said beside it, with its interval."""
    results = RunResults.read(in_memory(tmp_path / "run", trials=60, **MEASURED).folder)
    verdict, filtered = results.verdict, results.filter
    assert verdict is not None
    assert filtered is not None
    true = filtered.true_ratios["smart"]
    assert verdict.reason.startswith("the estimator is ")
    assert " off the sensor's estimate, the best eavesdropper (smart) " in verdict.reason
    assert verdict.reason.endswith(f", {times_text(true.ratio, true.interval)} against the true state")
    assert true.interval is not None
    assert true.interval[0] < true.ratio < true.interval[1]
    shown = list(closing.remarks(results.typed_summary))
    assert any(line.startswith("the sensor sends its filter's estimate") and "legitimate " in line for line in shown)


@pytest.mark.thorough
def test_sweeps_comparisons_and_views_say_it_too(tmp_path: Path) -> None:
    """A sweep has a column with the ratio against the truth, a comparison a heading, the view the verdict so far."""
    small: dict[str, Any] = {"slots": 60, "trials": 6, "expect": []}
    swept = sweep(
        "measured", {"legitimate.link.quality": [0.7, 0.9]}, out=tmp_path / "sweep", **small
    ).table.to_pylist()
    table = sweep_table(swept, ["legitimate.link.quality"])
    at = [column.heading for column in table.columns].index("times the true error")
    assert [row[at] == "–" for row in table.rows] == [row["peer"] == "legitimate" for row in swept]
    compared = compare("measured", schemes=["plain"], adversaries=["smart"], out=tmp_path / "compare", **small)
    for comparison in (compared, read_comparison(tmp_path / "compare")):
        assert comparison_heading(comparison).endswith(" · errors against the sensor's estimate")
    run_ = montecarlo("measured", out=tmp_path / "run", **{**small, "slots": 300, "trials": 1}).folder
    texts = [text for (text,) in rows(replay(run_, tmp_path / "view.rrd"), "title", "TextDocument:text").values()]
    assert any("off the sensor's estimate" in text and "so far" in text for text in map(_unescaped, texts))


def _unescaped(markdown: str) -> str:
    return markdown.replace("\\", "")


def test_the_ratio_against_the_truth_counts_the_second_half_of_all_trials() -> None:
    """Its interval is that of a ratio of means, and it does not depend on how slots and trials are divided."""
    trials = 6
    alone = [FilterTally(9, 1) for _ in range(trials)]
    draw = np.random.default_rng(2)
    errors = {name: factor * draw.exponential(size=(9, trials)) for name, factor in FACTORS.items()}
    together = FilterTally(9, trials)
    for part in (slice(0, 3), slice(3, 7), slice(7, 9)):
        together.add_errors({name: error[part] for name, error in errors.items()})
        for trial, tally in enumerate(alone):
            tally.add_errors({name: error[part, trial : trial + 1] for name, error in errors.items()})
    whole = together.compared("smart")
    sums = {name: error[5:].sum(axis=0) for name, error in errors.items()}
    assert whole.ratio == pytest.approx(sums["smart"].mean() / sums["legitimate"].mean())
    spread = ratio_error(sums["smart"], sums["legitimate"])
    assert whole.interval == pytest.approx(ratio_interval(whole.ratio, spread, trials))
    merged = FilterTally.merged(alone)
    assert merged is not None
    assert merged.compared("smart") == whole
    assert together.compared("smart", infinite_variance=True).interval is None
    assert math.isnan(FilterTally(9, 2).compared("smart").ratio)
    short = FilterTally(20, trials)
    short.add_errors(errors)
    assert short.compared("smart").interval is None
    assert short.compared("smart").ratio == pytest.approx(errors["smart"].mean() / errors["legitimate"].mean())


FACTORS = {"sensor": 0.5, "legitimate": 1.0, "smart": 3.0}


def test_the_errors_of_a_shard_of_one_trial_are_read_from_its_file() -> None:
    """By the example of a tally that has none yet."""
    tally = FilterTally(9, 1)
    tally.add_errors({name: np.full((9, 1), factor) for name, factor in FACTORS.items()})
    assert unpacked(packed(tally), FilterTally(9, 1)).compared("smart") == tally.compared("smart")


@pytest.mark.parametrize("begun", [0, 1])
def test_errors_of_a_shard_that_ended_before_its_first_slot_are_left_out(begun: int) -> None:
    """Whether it is the first one or the last one, or none has begun."""
    tallies = [FilterTally(9, 1), FilterTally(9, 1)]
    tallies[begun].add_errors({name: np.full((4, 1), factor) for name, factor in FACTORS.items()})
    merged, nothing = FilterTally.merged(tallies), FilterTally.merged([FilterTally(9, 1), FilterTally(9, 1)])
    assert merged is not None
    assert nothing is not None
    assert (merged.slots, merged.count, merged.sums["smart"]) == (0, 4, 12.0)
    assert {name: values.tolist() for name, values in merged.of_trials.items()} == {
        name: [4.0 * factor] for name, factor in FACTORS.items()
    }
    assert math.isnan(merged.compared("smart").ratio)
    assert nothing.of_trials == {}


@pytest.mark.thorough
def test_errors_against_the_true_state_have_standard_errors(tmp_path: Path) -> None:
    """Those of runs of one trial each, which have none; z compares the filter's errors with its covariance."""
    filtered = in_memory(tmp_path / "run", **MEASURED).summary["filter"]
    alone = [
        in_memory(tmp_path / str(trial), trials=1, record_trials=1, first_trial=trial, **MEASURED).summary["filter"]
        for trial in range(6)
    ]
    errors = filtered["standard_errors"]
    own = np.array([entry["mean_squared_error"] for entry in alone])
    assert errors["mean_squared_error"] == pytest.approx(own.std(ddof=1) / 6**0.5, rel=1e-9)
    for name, error in errors["mean_true_squared_errors"].items():
        values = np.array([entry["mean_true_squared_errors"][name] for entry in alone])
        assert error == pytest.approx(values.std(ddof=1) / 6**0.5, rel=1e-9)
    assert filtered["z"] == pytest.approx(z_of(own, filtered["mean_trace_covariance"]), rel=1e-6)
    assert alone[0]["z"] is alone[0]["standard_errors"]["mean_squared_error"] is None


def test_a_singular_noise_runs_and_is_warned_of(evedrop: Evedrop) -> None:
    """One measurement of two states: Q has rank one, and the warning says what that gives away."""
    measuring = {"plant__output_matrix": [[0.0, 1.0]], "plant__measurement_noise": [[0.01]]}
    (evedrop.folder / "loop.toml").write_text(tomli_w.dumps(changed(TANK, **{**MEASURED, **measuring})))
    done = evedrop("montecarlo", "loop.toml", "--trials", "5", "--out", "run")
    assert done.status == 0
    assert (
        "warning: process.Q is singular, as always with fewer measurements than states: apart from A, inputs"
        in done.err
    )
    Q = np.array(load(evedrop.folder / "run").process.Q)
    assert np.linalg.matrix_rank(Q, tol=1e-12) == 1


OFTEN = ("twenty trials", "filtered and betrayed")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[] if case in OFTEN else [pytest.mark.long]) for case in LIVE]
)
def test_a_live_loop_is_the_one_in_memory(case: str, tmp_path: Path) -> None:
    """Digests of all, the controller's too, and every recorded input: whatever the links and events are."""
    live = run(checked(changed(TANK, **LIVE[case]), "file"), out=tmp_path / "live")
    memory = in_memory(tmp_path / "memory", **LIVE[case])
    assert live.summary["ended"] == "complete"
    assert None not in digests(live).values()
    assert digests(live) == digests(memory)
    assert live.inputs is not None
    assert live.inputs.equals(memory.inputs)
    assert difference(live, memory).same
    timed = {"mean_solve_seconds", "longest_solve_seconds"}
    for name, value in memory.summary["controller"].items():
        if name not in {*timed, "mean_squared_errors", "mean_trace_covariance", "standard_errors"}:
            assert live.summary["controller"][name] == value, name
    here, there = (run.summary["controller"] for run in (memory, live))
    for mine, others in ((here, there), (here["standard_errors"], there["standard_errors"])):
        for name, value in others["mean_squared_errors"].items():
            same = mine["mean_squared_errors"][name]
            assert (value is None) == (same is None)
            assert value is None or value == pytest.approx(same, rel=1e-9)
    for name in ("failed_fraction", "clipped_fraction"):
        assert there["standard_errors"][name] == here["standard_errors"][name]
    assert live.summary["controller"]["mean_solve_seconds"] > 0.0


@pytest.mark.thorough
def test_a_killed_controller_is_named(evedrop: Evedrop) -> None:
    """The run fails, says who is at fault, and keeps what was measured."""
    (evedrop.folder / "loop.toml").write_text(tomli_w.dumps(changed(TANK, slots=200_000, **CALM)))
    live = evedrop.live("loop.toml", "--trials", "1", "--record-trials", "1")
    live.running()
    live.kill("controller")
    done = live.end()
    assert done.status == 3
    assert "controller was ended by signal 9" in done.err
    assert "logs/controller.log" in done.err
    live.nothing_left()
    assert live.results.summary["controller"]["digest"] is None
    inputs = live.results.inputs
    assert inputs is not None
    assert inputs.num_rows == live.results.summary["slots"]


@pytest.mark.thorough
def test_a_loop_can_be_paused_and_steered(evedrop: Evedrop) -> None:
    """The operator holds the run between two slots, changes a link, and lets it go on: as in any run."""
    (evedrop.folder / "loop.toml").write_text(tomli_w.dumps(changed(TANK, slots=200, **CALM)))
    live = evedrop.live("loop.toml", "--paused")
    live.held()
    for words in (("step", "50"), ("pause",), ("link", "legitimate", "cut"), ("step", "20"), ("resume",)):
        done = evedrop(words[0], "run", *words[1:])
        assert (done.status, done.err) == (0, ""), words
    assert live.end().status == 0
    results = live.results
    assert results.summary["ended"] == "complete"
    simulate(load(live.folder), evedrop.folder / "memory", silent, Plan(workers=1))
    assert digests(Results.read(evedrop.folder / "memory")) == digests(results)


def test_what_the_controller_did_differently_is_found(tmp_path: Path) -> None:
    """By slot and trial, with both values, where only its weights differ; and by its digests where nothing is recorded."""
    loop, other = (in_memory(tmp_path / str(weight), controller__input_weights=[weight]) for weight in (0.1, 0.2))
    result = difference(loop, other)
    assert not result.same
    assert result.text.startswith("first difference: slot 0, trial 0, controller: u [")
    assert " against [" in result.text


def test_the_closing_report_has_a_line_on_the_loop(evedrop: Evedrop) -> None:
    """Both errors, and what was clipped."""
    (evedrop.folder / "loop.toml").write_text(tomli_w.dumps(changed(TANK)))
    done = evedrop("montecarlo", "loop.toml", "--trials", "5", "--out", "run")
    assert done.status == 0
    line = next(line for line in done.out.splitlines() if line.startswith("controller "))
    assert line.startswith("controller lqr, 300 decisions; the estimator's error is ")
    assert "ignoring the input, " in line
    assert line.endswith("knowing the input")


def test_a_trial_is_the_same_alone_and_in_any_batch(tmp_path: Path) -> None:
    """Digests of every receiver and of the controller, trial by trial."""
    many = in_memory(tmp_path / "many").digests.to_pylist()
    alone = in_memory(tmp_path / "alone", trials=1, first_trial=4, record_trials=1).digests.to_pylist()
    assert {row["peer"] for row in alone} == {"legitimate", "smart", "naive", "controller"}
    assert all(row in many for row in alone)


def test_who_listens_changes_nothing(tmp_path: Path) -> None:
    """No eavesdropper moves the loop."""
    with_two = digests(in_memory(tmp_path / "two"))
    alone = digests(in_memory(tmp_path / "none", eavesdroppers={}))
    assert alone == {name: with_two[name] for name in alone}


def test_both_estimators_are_reported(tmp_path: Path) -> None:
    """Whichever is in the loop: with a controller that acts on the truth, both runs are of the same states."""
    runs = {
        knows: in_memory(
            tmp_path / str(knows),
            controller__acts_on="truth",
            legitimate__knows_input=knows,
        )
        for knows in (False, True)
    }
    ignoring, knowing = (runs[knows].summary["controller"]["mean_squared_errors"] for knows in (False, True))
    assert ignoring == pytest.approx(knowing, rel=1e-9)
    assert runs[True].summary["peers"]["legitimate"]["mean_squared_error"] == knowing["knowing_input"]
    assert runs[False].summary["peers"]["legitimate"]["mean_squared_error"] == ignoring["ignoring_input"]
    assert knowing["knowing_input"] != pytest.approx(knowing["ignoring_input"], rel=0.01)
    assert digests(runs[True])["controller"] == digests(runs[False])["controller"]
    assert digests(runs[True])["legitimate"] != digests(runs[False])["legitimate"]


def test_the_other_estimator_is_unknown_if_acknowledgements_are_forged(tmp_path: Path) -> None:
    """One that lacks a reference corrects its estimate by packets, so that the two differ by more than what inputs do."""
    for attack in ("none", "forge"):
        acknowledgements = {"link": {"quality": 0.9}, "attack": attack}
        results = in_memory(
            tmp_path / attack,
            encoding={"scheme": "open-loop"},
            eavesdroppers={},
            controller__acts_on="truth",
            legitimate__knows_input=True,
            acknowledgements=acknowledgements,
        )
        summary = results.summary["controller"]
        for errors in (summary["mean_squared_errors"], summary["standard_errors"]["mean_squared_errors"]):
            assert None not in errors.values() or attack == "forge"
        in_loop = results.summary["peers"]["legitimate"]["mean_squared_error"]
        assert summary["mean_squared_errors"]["knowing_input"] == in_loop
        assert (summary["mean_squared_errors"]["ignoring_input"] is None) == (attack == "forge")


def test_inputs_are_held_between_decisions(tmp_path: Path) -> None:
    """A decision every period slots."""
    results = in_memory(tmp_path / "run", controller__period=7)
    u = column(results.inputs, "u", trial=0)[:, 0]
    assert set(np.flatnonzero(np.diff(u)) + 1) <= set(range(0, 300, 7))
    assert results.summary["controller"]["decisions"] == 43


def test_late_packets_are_followed_with_the_inputs(tmp_path: Path) -> None:
    """A window that goes back over slots with inputs: without noise and disturbances, a receiver with them soon knows all."""
    link = {"quality": 0.9, "delay": {"model": "normal", "mean": 1.0, "standard_deviation": 1.0}}
    late = {}
    for knows in (False, True):
        changes: dict[str, Any] = {"legitimate__link": link, "legitimate__window": 4, "legitimate__knows_input": knows}
        quiet: dict[str, Any] = {"plant__disturbance_values": [[0.0]] * 300, "plant__noise": [[0.0, 0.0], [0.0, 0.0]]}
        results = in_memory(tmp_path / str(knows), **changes, **quiet, controller__acts_on="truth")
        errors = results.summary["controller"]["mean_squared_errors"]
        in_loop = results.summary["peers"]["legitimate"]["mean_squared_error"]
        assert errors == {"ignoring_input": None, "knowing_input": None, _NAMES[knows]: in_loop}
        late[knows] = column(results.slots, "mean_squared_error", peer="legitimate")[31:].max()
    assert late[True] < 1e-18
    assert late[False] > 1e-6


_NAMES = {False: "ignoring_input", True: "knowing_input"}


def test_a_plant_without_inputs_needs_no_controller(tmp_path: Path) -> None:
    """Disturbances alone move it; nothing is said of a controller."""
    plant = {"disturbances": ["rain"], "disturbance_matrix": [[1.0], [0.0]], "disturbance_values": [[0.01]] * 300}
    made = changed(TANK, plant=plant)
    del made["controller"]
    simulate(checked(made, "file"), tmp_path / "run", silent, Plan(workers=1))
    results = Results.read(tmp_path / "run")
    assert results.summary["controller"] is None
    assert results.inputs is None
    x = column(results.trials, "x", trial=0, peer="smart")
    assert np.allclose(np.diff(x[:, 0]), 0.01)


def test_other_modes_say_what_they_make_of_a_loop(tmp_path: Path) -> None:
    """Error coordinates refuse it; covariances are those that everybody reports, with or without it."""
    with pytest.raises(UsageError, match="error-coordinates follows errors, not states"):
        in_memory(tmp_path / "errors", Plan(Mode.ERROR_COORDINATES, 1))
    with_loop = in_memory(tmp_path / "loop", Plan(Mode.COVARIANCE_ONLY, 1))
    made = changed(TANK)
    del made["plant"], made["controller"]
    simulate(checked(made, "file"), tmp_path / "none", silent, Plan(Mode.COVARIANCE_ONLY, 1))
    assert with_loop.summary["peers"] == Results.read(tmp_path / "none").summary["peers"]
    assert with_loop.summary["controller"] is None


@pytest.mark.thorough
def test_workers_change_nothing(tmp_path: Path) -> None:
    """Trials of several blocks, by one worker and by two."""
    changes = {"slots": 20, "trials": 1100, "eavesdroppers": {}}
    single, two = (in_memory(tmp_path / str(count), Plan(workers=count), **changes) for count in (1, 2))
    timed = {"mean_solve_seconds", "longest_solve_seconds", "decisions"}
    controllers = [
        {key: value for key, value in run.summary["controller"].items() if key not in timed} for run in (single, two)
    ]
    assert controllers[0] == controllers[1]


def test_a_results_folder_runs_again_to_the_same_digests(tmp_path: Path) -> None:
    """With the disturbances that lie in it."""
    (tmp_path / "loop.toml").write_text(tomli_w.dumps(changed(TANK)))
    first = in_memory(tmp_path / "run")
    from evedrop.scenario.loading import load

    simulate(load(tmp_path / "run"), tmp_path / "again", silent, Plan(workers=1))
    assert digests(Results.read(tmp_path / "again")) == digests(first)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["controller"]["strategy"] == "lqr"
