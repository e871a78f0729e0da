"""`[plant]` and `[controller]` in a scenario: every mistake at once, and what right ones come to."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.errors import ScenarioError
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from tests.builders import changed, mistakes_of

LOOP: dict[str, Any] = {
    "title": "Loop",
    "slots": 4,
    "process": {
        "A": [[1.0, 0.0], [0.0, 1.0]],
        "Q": [[1e-5, 0.0], [0.0, 1e-5]],
        "initial_covariance": [[1e-4, 0.0], [0.0, 1e-4]],
        "reference": [55.0, 50.0],
        "states": ["SOC", "LOH"],
        "units": ["%", "%"],
    },
    "plant": {
        "inputs": ["P_H", "P_grid"],
        "input_matrix": [[1.56e-3, 1.56e-3], [-5.66e-3, 0.0]],
        "input_units": ["kW", "kW"],
        "input_lower": [-1.5, -3.0],
        "input_upper": [1.5, 3.0],
        "disturbances": ["P_solar", "P_load"],
        "disturbance_matrix": [[1.56e-3, -1.56e-3], [0.0, 0.0]],
        "disturbance_values": [[0.0, 0.4], [0.5, 0.4], [0.25, 0.1], [0.0, 0.3]],
        "noise": [[0.0, 0.0], [0.0, 0.0]],
        "start": [54.0, 50.5],
        "state_lower": [20.0, 10.0],
        "state_upper": [90.0, 90.0],
    },
    "controller": {
        "strategy": "lqr",
        "period": 2,
        "acts_on": "estimate",
        "state_weights": [1.0, 0.3],
        "input_weights": [0.02, 0.05],
        "rate_weights": [1.0, 0.02],
        "rate_limits": [0.05, 3.0],
    },
    "encoding": {"scheme": "innovation", "state_probability": 0.5},
    "legitimate": {"link": {"quality": 0.9}, "knows_input": True},
}


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "rows of B": (
        {"plant__input_matrix": [[1.0, 1.0]]},
        "plant.input_matrix: has 1 rows; expected 2, one for each state",
    ),
    "columns of B": (
        {"plant__input_matrix": [[1.0], [1.0]]},
        "plant.input_matrix: has a row of 1 numbers; expected 2, one for each of inputs",
    ),
    "no B": ({"plant__input_matrix": None}, "plant.input_matrix: is missing; expected a row for each state"),
    "units": ({"plant__input_units": ["kW"]}, "plant.input_units: has 1 entries; expected 2, one for each of inputs"),
    "a name twice": ({"plant__inputs": ["P", "P"]}, 'plant.inputs: has "P" twice'),
    "limits of inputs": (
        {"plant__input_lower": [2.0, -3.0]},
        "plant.input_lower: entry 0 is 2.0, above that of input_upper, which is 1.5; swap them",
    ),
    "how many limits": ({"plant__input_upper": [1.0]}, "plant.input_upper: has 1 entries; expected 2, one for each of"),
    "limits of states": (
        {"plant__state_lower": [95.0, 10.0]},
        "plant.state_lower: entry 0 is 95.0, above that of state_upper, which is 90.0; swap them",
    ),
    "start": (
        {"plant__start": [95.0, 50.0]},
        "plant.start: entry 0 is 95.0, outside its limits, 20.0 to 90.0; change one of them",
    ),
    "length of start": ({"plant__start": [50.0]}, "plant.start: has 1 entries; expected 2, one for each state"),
    "reference": (
        {"process__reference": [5.0, 50.0]},
        "process.reference: entry 0 is 5.0, outside its limits, 20.0 to 90.0; change one of them",
    ),
    "length of reference": (
        {"process__reference": [5.0]},
        "process.reference: has 1 entries; expected 2, one for each",
    ),
    "names of states": ({"process__states": ["SOC"]}, "process.states: has 1 entries; expected 2, one for each state"),
    "noise": (
        {"plant__noise": [[1.0, 2.0], [2.0, 1.0]]},
        "plant.noise: has an eigenvalue below 0; expected a covariance",
    ),
    "asymmetric noise": (
        {"plant__noise": [[1.0, 2.0], [0.0, 1.0]]},
        "plant.noise: is not symmetric; expected a covariance",
    ),
    "no disturbances": (
        {"plant__disturbance_values": None},
        "plant.disturbance_file: is missing; expected disturbance_f",
    ),
    "few disturbances": (
        {"slots": 5},
        "plant.disturbance_values: has 4 rows; expected slots, which is 5, or more",
    ),
    "short disturbances": (
        {"plant__disturbance_values": [[0.0, 1.0], [1.0], [1.0], [1.0]]},
        "plant.disturbance_values: row 1 has 1 numbers; expected 2, one for each of disturbances",
    ),
    "no plant": (
        {"plant": None},
        "plant: has no inputs, but there is a controller; expected a table [plant] with inputs",
    ),
    "no controller": (
        {"controller": None},
        "controller: is missing; expected a table [controller] that decides P_H or P_grid, or a plant without inputs",
    ),
    "knows nothing": (
        {"plant": None, "controller": None},
        "legitimate.knows_input: is true, but there are no inputs; add a [plant] and a [controller], or remove the line",
    ),
    "strategy": ({"controller__strategy": "pid"}, 'controller.strategy: is "pid"; expected lqr'),
    "parameter": (
        {"controller__gain": 3.0},
        "controller.gain: is set, but the strategy lqr has no such parameter; remove the line",
    ),
    "weights": (
        {"controller__state_weights": [1.0]},
        "controller.state_weights: has 1 entries; expected 2, one for each",
    ),
    "negative weight": (
        {"controller__rate_weights": [-1.0, 0.0]},
        "controller.rate_weights: has -1.0; expected numbers of",
    ),
    "no weight": (
        {"controller__input_weights": [0.0, 1.0], "controller__rate_weights": None},
        "controller.input_weights: leave an input without weight; expected input_weights, or rate_weights, above 0",
    ),
    "out of reach": (
        {"plant__input_matrix": [[1.0, 1.0], [0.0, 0.0]]},
        "controller.state_weights: weigh a state that no input can keep from growing",
    ),
    "killed": (
        {"event": [{"from": 1, "to": 2, "kill": "legitimate"}]},
        "event.0.kill: is legitimate, but the controller acts on its estimate, and the loop would stand still; expected a cut",
    ),
    "killed although told": (
        {"event": [{"from": 1, "to": 2, "pause": "legitimate"}], "controller__acts_on": "truth"},
        "event.0.pause: is legitimate, but it waits for the inputs, and the loop would stand still; expected a cut",
    ),
    "no filter": (
        {"process__Q": "filter"},
        'process.Q: is "filter", but the sensor has none; expected a matrix, or output_matrix and measurement_noise in [p',
    ),
    "filtered without A": (
        {
            "process__Q": "filter",
            "process__A": None,
            "plant__output_matrix": [[1.0, 0.0]],
            "plant__measurement_noise": [[0.01]],
        },
        "process.A: is missing; expected A = ",
    ),
    "filtered, A is none": (
        {
            "process__Q": "filter",
            "process__A": False,
            "plant__output_matrix": [[1.0, 0.0]],
            "plant__measurement_noise": [[0.01]],
        },
        "process.A: is false; expected ",
    ),
    "measured without noise": (
        {"plant__output_matrix": [[1.0, 0.0]]},
        "plant.measurement_noise: is missing, but output_matrix is given; expected measurement_noise = [[0.01]], or neither",
    ),
    "measured states": (
        {"plant__output_matrix": [[1.0]], "plant__measurement_noise": [[0.01]]},
        "plant.output_matrix: has a row of 1 numbers; expected 2, one for each state",
    ),
    "noise of measurements": (
        {"plant__output_matrix": [[1.0, 0.0]], "plant__measurement_noise": [[0.01, 0.0]]},
        "plant.measurement_noise: has rows of [2] numbers; expected 1 × 1, as output_matrix has rows",
    ),
    "unseen": (
        {"plant__output_matrix": [[1.0, 0.0]], "plant__measurement_noise": [[0.01]]},
        "plant.output_matrix: shows only 1 of 2 directions of a mode that does not decay, an eigenvalue of A of modulus 1",
    ),
    "inverse of Q": (
        {
            "process__singular_noise": True,
            "eavesdroppers": {"eve": {"strategy": "tracker", "link": {"quality": 0.5}}},
        },
        "eavesdroppers.eve.strategy: is tracker, which uses the inverse of Q, and Q may be singular",
    ),
    "reserved": (
        {"eavesdroppers": {"controller": {"strategy": "smart", "link": {"quality": 0.5}}}},
        'eavesdroppers.controller: is "controller"; expected any name but',
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_says_where_what_and_what_instead(case: str) -> None:
    """Path, what was found, what was expected."""
    changes, sentence = WRONG[case]
    assert any(line.startswith(sentence) for line in mistakes_of(checked, changed(LOOP, **changes), "file"))


def paths(**changes: Any) -> list[str]:
    """Where the mistakes are."""
    return [line.partition(":")[0] for line in mistakes_of(checked, changed(LOOP, **changes), "file")]


def test_all_mistakes_are_told_at_once() -> None:
    """Those of every table by itself; and, where tables are valid by themselves, those that they have together."""
    assert paths(plant__input_units=["kW"], controller__horizon=0) == ["plant.input_units", "controller.horizon"]
    assert paths(plant__start=[95.0, 50.0], controller__state_weights=[1.0]) == [
        "plant.start",
        "controller.state_weights",
    ]
    both = paths(plant__input_units=["kW"], controller__state_weights=[1.0])
    assert both == ["plant.input_units"], "a table with a mistake of its own is not compared with others"


def test_states_are_deviations_from_the_reference() -> None:
    """Start and limits of the states are levels in the file, and deviations in the plant."""
    scenario = checked(changed(LOOP), "file")
    assert scenario.driven is not None
    assert np.array_equal(scenario.driven.start, [-1.0, 0.5])
    assert np.array_equal(scenario.driven.state_upper, [35.0, 40.0])
    assert scenario.assignment is not None
    assert np.array_equal(scenario.assignment.rate_limits, [0.1, 6.0]), "per slot in the file, per decision in the loop"
    bare = checked(changed(LOOP, plant__start=None, plant__noise=None, plant__state_lower=None), "file")
    assert bare.driven is not None
    assert np.array_equal(bare.driven.start, [0.0, 0.0])
    assert np.array_equal(bare.driven.noise, np.zeros((2, 2)))
    assert np.array_equal(bare.driven.state_lower, [-np.inf, -np.inf])


CSV = "# a day\nP_load [kW],other,P_solar [kW]\n0.4,x,0\n0.4,x,0.5\n0.1,x,0.25\n0.3,x,0.1\n9,x,9\n"


def scenario_file(folder: Path, text: str = CSV) -> Path:
    """A scenario file with its disturbances in the same folder."""
    import tomli_w

    tables = changed(LOOP, plant__disturbance_values=None, plant__disturbance_file="day.csv")
    (folder / "loop.toml").write_text(tomli_w.dumps(tables))
    (folder / "day.csv").write_text(text)
    return folder / "loop.toml"


def test_disturbances_are_read_beside_the_scenario(tmp_path: Path) -> None:
    """By name, in the order of the scenario, whatever other columns there are; a longer file is read as far as needed."""
    scenario = load(scenario_file(tmp_path))
    assert np.array_equal(disturbances_of(scenario), [[0.0, 0.4], [0.5, 0.4], [0.25, 0.1], [0.1, 0.3]])
    assert Scenario.model_validate(scenario.model_dump(mode="json")) == scenario


def test_results_hold_the_disturbances_that_their_scenario_names(tmp_path: Path) -> None:
    """A results folder can be run again wherever it is moved to, to the same bits."""
    scenario = load(scenario_file(tmp_path))
    folder = tmp_path / "results"
    folder.mkdir()
    write_resolved(folder, scenario)
    moved = folder.rename(tmp_path / "elsewhere")
    assert 'disturbance_file = "disturbances.csv"' in (moved / "scenario.toml").read_text()
    assert np.array_equal(disturbances_of(load(moved)), disturbances_of(scenario))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is empty; expected a line of names such as"),
        ("P_solar\n1\n", 'line 1 has no column "P_load", only "P_solar"; expected P_load among them'),
        ("P_solar,P_load\n1,2\n1,x\n", 'line 3: P_load is "x"; expected a finite number'),
        ("P_solar,P_load\n1,2\n1\n", "line 3 has 1 columns; expected 2, as the first line has"),
        ("P_solar,P_load\n1,nan\n", 'line 2: P_load is "nan"; expected a finite number'),
        ("P_solar,P_load\n1,2\n", "has 1 rows; expected slots, which is 4, or more"),
    ],
)
def test_a_file_that_will_not_do_is_told(text: str, what: str, tmp_path: Path) -> None:
    """In the same words as any mistake, with the entry that names it."""
    with pytest.raises(ScenarioError) as caught:
        load(scenario_file(tmp_path, text))
    assert any("plant.disturbance_file: " in line and what in line for line in caught.value.mistakes)


def test_what_may_never_end_is_not_read(tmp_path: Path) -> None:
    """A pipe without a writer is refused at once."""
    os.mkfifo(tmp_path / "pipe.csv")
    (mistake,) = mistakes_of(
        checked,
        changed(LOOP, plant__disturbance_values=None, plant__disturbance_file=str(tmp_path / "pipe.csv")),
        "file",
    )
    assert "pipe.csv cannot be read (it is a pipe or a device, not a file); expected a CSV file" in mistake


def test_a_file_that_is_not_there_is_told() -> None:
    """A file is refused, too, if the numbers themselves are also given."""
    missing = mistakes_of(
        checked, changed(LOOP, plant__disturbance_values=None, plant__disturbance_file="none.csv"), "file"
    )
    assert len(missing) == 1
    assert missing[0].startswith(
        "plant.disturbance_file: none.csv cannot be read (No such file or directory); expected"
    )
    assert mistakes_of(checked, changed(LOOP, plant__disturbance_file="none.csv"), "file") == [
        "plant.disturbance_file: is given together with disturbance_values; expected one of them"
    ]
