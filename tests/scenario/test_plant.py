"""`[plant]` and `[controller]` in a scenario: every mistake at once, and what right ones come to."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.errors import ScenarioError
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.dry_run import foreign
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from tests.builders import changed, mistakes_of, places_of
from tests.golden.pages import Golden

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
        "plant.input_matrix",
    ),
    "columns of B": (
        {"plant__input_matrix": [[1.0], [1.0]]},
        "plant.input_matrix",
    ),
    "no B": ({"plant__input_matrix": None}, "plant.input_matrix"),
    "units": ({"plant__input_units": ["kW"]}, "plant.input_units"),
    "a name twice": ({"plant__inputs": ["P", "P"]}, "plant.inputs"),
    "a state twice": ({"process__states": ["SOC", "SOC"]}, "process.states"),
    "limits of inputs": (
        {"plant__input_lower": [2.0, -3.0]},
        "plant.input_lower",
    ),
    "how many limits": ({"plant__input_upper": [1.0]}, "plant.input_upper"),
    "limits of states": (
        {"plant__state_lower": [95.0, 10.0]},
        "plant.state_lower",
    ),
    "start": (
        {"plant__start": [95.0, 50.0]},
        "plant.start",
    ),
    "length of start": ({"plant__start": [50.0]}, "plant.start"),
    "reference": (
        {"process__reference": [5.0, 50.0]},
        "process.reference",
    ),
    "length of reference": (
        {"process__reference": [5.0]},
        "process.reference",
    ),
    "names of states": ({"process__states": ["SOC"]}, "process.states"),
    "noise": (
        {"plant__noise": [[1.0, 2.0], [2.0, 1.0]]},
        "plant.noise",
    ),
    "asymmetric noise": (
        {"plant__noise": [[1.0, 2.0], [0.0, 1.0]]},
        "plant.noise",
    ),
    "no disturbances": (
        {"plant__disturbance_values": None},
        "plant.disturbance_file",
    ),
    "few disturbances": (
        {"slots": 5},
        "plant.disturbance_values",
    ),
    "short disturbances": (
        {"plant__disturbance_values": [[0.0, 1.0], [1.0], [1.0], [1.0]]},
        "plant.disturbance_values",
    ),
    "an infinite disturbance": (
        {"plant__disturbance_values": [[0.0, 1.0], [1.0, np.inf], [1.0, 0.0], [1.0, 0.0]]},
        "plant.disturbance_values.1.1",
    ),
    "no number in a matrix": (
        {"plant__disturbance_matrix": [[1.0, np.nan], [0.0, 0.0]]},
        "plant.disturbance_matrix.0.1",
    ),
    "no number as noise": ({"plant__noise": [[np.nan, 0.0], [0.0, 0.0]]}, "plant.noise.0.0"),
    "too large disturbances": (
        {"plant__disturbance_values": [[0.0, 1.0], [1.0, -1e101], [1.0, 0.0], [1.0, 0.0]]},
        "plant.disturbance_values",
    ),
    "too large a start": ({"plant__start": [1e101, 50.0], "plant__state_upper": None}, "plant.start"),
    "name of a disturbance": ({"plant__disturbances": ["P_solar", "load, kW"]}, "plant.disturbances"),
    "unit of a disturbance": ({"plant__disturbance_units": ["kW", "[kW]"]}, "plant.disturbance_units"),
    "disturbances without names": (
        {"plant__disturbances": None, "plant__disturbance_matrix": None},
        "plant.disturbances",
    ),
    "no plant": (
        {"plant": None},
        "plant",
    ),
    "no controller": (
        {"controller": None},
        "controller",
    ),
    "knows nothing": (
        {"plant": None, "controller": None},
        "legitimate.knows_input",
    ),
    "strategy": ({"controller__strategy": "pid"}, "controller.strategy"),
    "parameter": (
        {"controller__gain": 3.0},
        "controller.gain",
    ),
    "weights": (
        {"controller__state_weights": [1.0]},
        "controller.state_weights",
    ),
    "negative weight": (
        {"controller__rate_weights": [-1.0, 0.0]},
        "controller.rate_weights",
    ),
    "no weight": (
        {"controller__input_weights": [0.0, 1.0], "controller__rate_weights": None},
        "controller.input_weights",
    ),
    "out of reach": (
        {"plant__input_matrix": [[1.0, 1.0], [0.0, 0.0]]},
        "controller.state_weights",
    ),
    "killed": (
        {"event": [{"from": 1, "to": 2, "kill": "legitimate"}]},
        "event.0.kill",
    ),
    "killed although told": (
        {"event": [{"from": 1, "to": 2, "pause": "legitimate"}], "controller__acts_on": "truth"},
        "event.0.pause",
    ),
    "no filter": (
        {"process__Q": "filter"},
        "process.Q",
    ),
    "filtered without A": (
        {
            "process__Q": "filter",
            "process__A": None,
            "plant__output_matrix": [[1.0, 0.0]],
            "plant__measurement_noise": [[0.01]],
        },
        "process.A",
    ),
    "filtered, A is none": (
        {
            "process__Q": "filter",
            "process__A": False,
            "plant__output_matrix": [[1.0, 0.0]],
            "plant__measurement_noise": [[0.01]],
        },
        "process.A",
    ),
    "measured without noise": (
        {"plant__output_matrix": [[1.0, 0.0]]},
        "plant.measurement_noise",
    ),
    "measured states": (
        {"plant__output_matrix": [[1.0]], "plant__measurement_noise": [[0.01]]},
        "plant.output_matrix",
    ),
    "noise of measurements": (
        {"plant__output_matrix": [[1.0, 0.0]], "plant__measurement_noise": [[0.01, 0.0]]},
        "plant.measurement_noise",
    ),
    "unseen": (
        {"plant__output_matrix": [[1.0, 0.0]], "plant__measurement_noise": [[0.01]]},
        "plant.output_matrix",
    ),
    "inverse of Q": (
        {
            "process__singular_noise": True,
            "eavesdroppers": {"eve": {"strategy": "tracker", "link": {"quality": 0.5}}},
        },
        "eavesdroppers.eve.strategy",
    ),
    "reserved": (
        {"eavesdroppers": {"controller": {"strategy": "smart", "link": {"quality": 0.5}}}},
        "eavesdroppers.controller",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_says_where_what_and_what_instead(case: str, golden: Golden) -> None:
    """Path, what was found, what was expected."""
    changes, place = WRONG[case]
    mistakes = mistakes_of(checked, changed(LOOP, **changes), "file")
    assert place in places_of(mistakes)
    golden("check", mistakes)


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


def test_rows_of_different_lengths_are_the_plants_mistake_alone() -> None:
    """No controller is asked about such a plant."""
    (line,) = mistakes_of(checked, changed(LOOP, plant__noise=[[1e-4, 0.0], [0.0]]), "file")
    assert line == "plant.noise: has a row that is not of 2 numbers; expected 2 × 2, as A is"


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
    ("text", "message"),
    [
        ("", "is empty; expected a line of names such as"),
        ("P_solar\n1\n", 'line 1 has no column "P_load", only "P_solar"; expected P_load among them'),
        ("P_solar,P_load\n1,2\n1,x\n", 'line 3: P_load is "x"; expected a finite number'),
        ("P_solar,P_load\n1,2\n1\n", "line 3 has 1 column; expected 2, as the first line has"),
        ("P_solar,P_load\n1,nan\n", 'line 2: P_load is "nan"; expected a finite number'),
        ("P_solar,P_load\n1,2\n", "has 1 row; expected slots, which is 4, or more"),
    ],
)
def test_a_file_that_will_not_do_is_told(text: str, message: str, tmp_path: Path) -> None:
    """In the same words as any mistake, with the entry that names it."""
    with pytest.raises(ScenarioError) as caught:
        load(scenario_file(tmp_path, text))
    assert any("plant.disturbance_file: " in line and message in line for line in caught.value.mistakes)


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


@pytest.mark.parametrize("own", [{}, {"integrity": {"attack": {"model": "replay", "recorded": 2}}}], ids=str)
def test_every_class_of_a_closed_loop_is_built_in(own: dict[str, Any]) -> None:
    """Results whose metrics are lost can be looked at: theory needs no class that is not built in."""
    assert not foreign({**LOOP, **own})
