"""States that a scenario takes from a recording or a program: what is read, and every mistake at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import compare, montecarlo
from evedrop.errors import ScenarioError, UsageError
from evedrop.results.diff import difference
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.input_files import states_of
from evedrop.scenario.loading import checked, load
from evedrop.scenario.theory import expectations_of
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.studies.matchups import matchups_of
from tests.builders import MARGINAL, listener, mistakes_of, places_of, process_table, tables_of
from tests.golden.pages import Golden

PROGRAM = {"key": "robot/pose", "connect": "tcp/127.0.0.1:7447"}


def given(entries: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A scenario of two states, with these entries of `[process]`."""
    process = {**process_table(MARGINAL), "states": ["x", "v"], **entries}
    return tables_of(
        MARGINAL, slots=3, **{"eavesdroppers": {"eve": listener("smart", 0.8)}, **more, "process": process}
    )


ROWS = [[0.1, 2.0], [0.2, 2.5], [0.7, -1.0]]


@pytest.mark.parametrize(
    ("entries", "more", "place"),
    [
        ({"source": "file"}, {}, "process.state_file"),
        ({"source": "zenoh"}, {}, "process.zenoh"),
        ({"state_values": ROWS}, {}, "process.source"),
        ({"zenoh": PROGRAM}, {}, "process.source"),
        ({"source": "files", "state_values": ROWS}, {}, "process.source"),
        ({"source": "file", "state_values": ROWS, "states": None}, {}, "process.states"),
        ({"source": "file", "state_file": "pose.csv", "states": None}, {}, "process.states"),
        ({"source": "file", "state_values": ROWS, "states": ["x", "x"]}, {}, "process.states"),
        ({"source": "file", "state_values": ROWS, "states": ["x", "v [m/s]"]}, {}, "process.states"),
        ({"source": "file", "state_values": ROWS, "units": ["m", "m,s"]}, {}, "process.units"),
        (
            {"source": "file", "state_values": ROWS[:2]},
            {},
            "process.state_values",
        ),
        ({"source": "file", "state_values": [[1.0]] * 3}, {}, "process.state_values"),
        ({"source": "file", "state_values": [*ROWS, [0.0, 1e101]]}, {}, "process.state_values"),
        ({"source": "file", "state_values": ROWS, "state_file": "a.csv"}, {}, "process.state_file"),
        ({"source": "file", "state_file": "missing.csv"}, {}, "process.state_file"),
        ({"theory": True}, {}, "process.theory"),
        ({"source": "zenoh", "zenoh": {"key": "a"}}, {}, "process.zenoh.connect"),
        ({"source": "zenoh", "zenoh": {**PROGRAM, "listen": "tcp/[::]:1"}}, {}, "process.zenoh.connect"),
        ({"source": "zenoh", "zenoh": {**PROGRAM, "key": "a/**"}}, {}, "process.zenoh.key"),
        ({"source": "zenoh", "zenoh": {**PROGRAM, "connect": "here"}}, {}, "process.zenoh.connect"),
        (
            {"source": "zenoh", "zenoh": {**PROGRAM, "offsets": [4]}},
            {},
            "process.zenoh.offsets",
        ),
        ({"source": "zenoh", "zenoh": PROGRAM}, {"shards": 2, "trials": 4}, "shards"),
        (
            {"source": "file", "state_values": ROWS},
            {"plant": {"noise": [[0.0, 0.0], [0.0, 0.0]]}},
            "process.source",
        ),
        (
            {"source": "file", "state_values": ROWS},
            {"encoding": {"scheme": "twin-track"}},
            "encoding.scheme",
        ),
        (
            {"source": "file", "state_values": ROWS},
            {"expect": [{"metric": "eve.theoretical_trace_covariance", "below": 1.0}]},
            "expect.0.metric",
        ),
    ],
)
def test_mistakes_are_reported(entries: dict[str, Any], more: dict[str, Any], place: str, golden: Golden) -> None:
    """Each with the entry that has it."""
    mistakes = mistakes_of(checked, given(entries, **more), "file")
    assert place in places_of(mistakes)
    golden("check", mistakes)


def test_a_file_is_read_and_kept(tmp_path: Path) -> None:
    """By names, with times that start anywhere; the results folder has the numbers of the slots, to the last bit."""
    lines = [f"{17 + 0.1 * k},{v!r},a,{x!r}" for k, (x, v) in enumerate([*ROWS, [9.0, 9.0]])]
    (tmp_path / "pose.csv").write_text("\n".join(["time [s],v [m/s],who,x [m]", *lines]))
    entries = {
        "source": "file",
        "state_file": str(tmp_path / "pose.csv"),
        "units": ["m", "m/s"],
        "reference": [0.3, 0.1],
    }
    scenario = checked(given(entries, slot_seconds=0.1), "file")
    assert scenario.process.state_values == ROWS
    folder = tmp_path / "results"
    folder.mkdir()
    write_resolved(folder, scenario)
    again, states = load(folder), states_of(scenario)
    assert states is not None
    assert np.allclose(states, np.array(ROWS) - [0.3, 0.1], rtol=1e-15)
    assert np.array_equal(np.array(states_of(again)), states)
    assert again.model_dump(exclude={"made_with"}) == scenario.model_dump(exclude={"made_with"})


def test_times_that_miss_a_slot_are_reported(tmp_path: Path) -> None:
    """Measured times may scatter by a tenth of a slot, and no more."""
    (tmp_path / "pose.csv").write_text("time,x,v\n5,1,1\n6.08,1,1\n7.3,1,1\n")
    with pytest.raises(ScenarioError) as caught:
        checked(given({"source": "file", "state_file": str(tmp_path / "pose.csv")}), "file")
    assert len(caught.value.mistakes) == 1
    assert "line 4: the time is 7.3 s after 6.08 s" in caught.value.mistakes[0]


def test_theory_is_there_only_if_the_model_is_said_to_hold() -> None:
    """And then it is of a model: there is no z."""
    for theory in (None, False, True):
        entries = {"source": "file", "state_values": ROWS, "theory": theory}
        expectation = expectations_of(checked(given(entries), "file"))["eve"]
        assert expectation.of_model
        assert expectation.known is (theory is True)
        assert expectation.assumed is (theory is not True)
        assert np.isfinite(expectation.traces(3)).all() == (theory is True)


def test_the_results_of_given_states(tmp_path: Path) -> None:
    """No theory, and a sentence that says so; the folder repeats the run."""
    scenario = checked(given({"source": "file", "state_values": ROWS}), "file")
    result = montecarlo(scenario, trials=12, out=tmp_path / "one", plan=Plan(workers=1))
    peer = result.summary["peers"]["eve"]
    assert peer["theoretical_trace_covariance"] is None
    assert peer["z"] == {"mean_squared_error": None}
    assert result.summary["surprising"] is None
    verdict = result.summary["secrecy"]["eve"]
    assert (verdict["relative_by_theory"], verdict["perfect_by_theory"], verdict["leak"]) == (None, None, None)
    assert "what theory expects of these states is not known" in verdict["sentence"]
    assert difference(result, montecarlo(tmp_path / "one", trials=12, out=tmp_path / "two", plan=Plan(workers=1))).same


def test_a_recording_is_enough_for_other_schemes_and_for_covariances(tmp_path: Path) -> None:
    """`twin-track` is left out of comparisons; error coordinates are refused."""
    scenario = checked(given({"source": "file", "state_values": ROWS}), "file")
    assert "twin-track" not in {group.scenario.encoding.scheme for group in matchups_of(scenario).groups}
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1)
    assert montecarlo(scenario, trials=2, out=tmp_path / "covariances", plan=plan).summary["ended"] == "complete"
    with pytest.raises(UsageError, match="the states are given"):
        montecarlo(scenario, trials=2, out=tmp_path / "errors", plan=Plan(Mode.ERROR_COORDINATES, workers=1))


def test_the_scenarios_of_a_comparison_can_be_run(tmp_path: Path) -> None:
    """They name the file of states in their folder."""
    scenario = checked(given({"source": "file", "state_values": ROWS}), "file")
    result = compare(scenario, schemes=["plain"], adversaries=["naive"], trials=2, out=tmp_path, plan=Plan(workers=1))
    cell = result.cell("plain", "naive").eavesdropper
    assert cell is not None
    assert cell.theory is None
    written = next((tmp_path / "scenarios").glob("*.toml"))
    assert load(written).process.state_values == ROWS


def test_a_program_cannot_be_asked_in_memory(tmp_path: Path) -> None:
    """The message says what can be done; a file that the scenario names as well is used if it says so."""
    entries = {"source": "zenoh", "zenoh": PROGRAM, "state_file": str(tmp_path / "pose.csv")}  # not read, nor there
    with pytest.raises(UsageError, match="only a live run can take states from a program"):
        montecarlo(checked(given(entries), "file"), trials=2, out=tmp_path / "refused")
    assert not (tmp_path / "refused").exists()
    with pytest.raises(UsageError, match="the states are given"):
        montecarlo(checked(given(entries), "file"), out=tmp_path / "refused", plan=Plan(Mode.ERROR_COORDINATES))
    (tmp_path / "pose.csv").write_text("x,v\n" + "".join(f"{x},{v}\n" for x, v in ROWS))
    states = states_of(checked(given({**entries, "source": "file"}), "file"))
    assert np.array_equal(np.array(states), ROWS)
