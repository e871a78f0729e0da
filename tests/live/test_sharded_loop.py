"""A closed loop in shards is the loop without them: inputs, controller, filter, household; and what a dead router costs."""

from __future__ import annotations

import copy
import os
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from evedrop import montecarlo, run
from evedrop.results.crash_proof_tables import last_round
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from tests.builders import digests_of
from tests.by_hand import as_if_undisturbed
from tests.conftest import Evedrop, wait_until
from tests.live.test_shards import child, close, in_order
from tests.studies.applications.microgrid.test_microgrid import part_of_day

TIMED = {"decisions", "mean_solve_seconds", "longest_solve_seconds"}
"""The controller's metrics that depend on its own process."""
TRIALS, SLOTS, RECORDED = 5, 300, 4
HOUSE: dict[str, Any] = {
    "trials": TRIALS,
    "record_trials": RECORDED,
    "encoding__state_probability": 0.3,
    "plant__output_matrix": [[1.0, 0.0], [0.0, 1.0]],
    "plant__measurement_noise": [[1e-4, 0.0], [0.0, 1e-4]],
    "controller__period": 10,
    "household__window_seconds": 10.0,
    "eavesdroppers__bayesian__strategy": "smart",
    "event": [{"from": 90, "to": 170, "kill": "smart", "state": "last"}, {"from": 100, "to": 140, "cut": "legitimate"}],
}
"""Of a house whose sensor filters, whose controller is cut off for a while, and one of whose eavesdroppers is restarted."""

Ran = Callable[[int], Results]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """The run in this number of shards; in memory for 0."""
    folder = tmp_path_factory.mktemp("loops")
    noon = part_of_day("microgrid", 43_200, SLOTS, **HOUSE)
    expect = [{"metric": "household.summed_difference", "above": 0.0}]

    @cache
    def once(shards: int) -> Results:
        if shards == 0:
            return montecarlo(noon, out=folder / "memory", trials=TRIALS, expect=expect)
        return run(noon, out=folder / str(shards), shards=shards, expect=expect)

    return once


def inputs_of(results: Results) -> pa.Table:
    """The table of inputs, by slot and trial."""
    assert results.inputs is not None
    return results.inputs.sort_by([("slot", "ascending"), ("trial", "ascending")])


@pytest.mark.long
@pytest.mark.parametrize("other", [0, 1])
def test_what_is_kept_by_trial_is_the_same_to_the_bit(ran: Ran, other: int) -> None:
    """Inputs and recorded trials, the digests of everybody and the controller, and the house."""
    assert inputs_of(ran(2)).equals(inputs_of(ran(other)))
    assert inputs_of(ran(2)).num_rows == SLOTS * RECORDED
    for name in ("trials", "digests"):
        assert in_order(getattr(ran(2), name)) == in_order(getattr(ran(other), name))
    summary, wanted = ran(2).summary, ran(other).summary
    assert digests_of(ran(2)) == digests_of(ran(other))
    assert summary["controller"]["digest"] == wanted["controller"]["digest"] is not None
    assert summary["household"] == wanted["household"]
    assert 0 < summary["household"]["active_windows"] < summary["household"]["windows"] == 29


@pytest.mark.thorough
@pytest.mark.parametrize("other", [0, 1])
def test_the_rest_of_the_summary_agrees(ran: Ran, other: int) -> None:
    """Within rounding, of the same keys; against memory but for its mode."""
    actual, wanted = (copy.deepcopy(dict(ran(shards).summary)) for shards in (2, other))
    for summary in (actual, wanted):
        summary["controller"] = {name: value for name, value in summary["controller"].items() if name not in TIMED}
        summary["mode"] = "any"
        for peer in (summary["controller"], *summary["peers"].values()):
            assert peer["standard_errors"]["mean_trace_covariance"] > 0.0
    close(actual, wanted, "summary")
    assert actual["filter"]["mean_squared_error"] > 0.0
    assert actual["controller"]["mean_squared_errors"]["knowing_input"] > 0.0


def test_decisions_are_those_of_all_shards(ran: Ran) -> None:
    """Each shard has a controller, which decides for its trials at once."""
    first, two = (ran(shards).summary["controller"] for shards in (1, 2))
    assert (first["decisions"], two["decisions"]) == (30, 60)
    assert two["longest_solve_seconds"] >= two["mean_solve_seconds"] > 0.0


@pytest.mark.thorough
def test_the_folder_is_that_of_a_loop(ran: Ran) -> None:
    """With the disturbances that its scenario names, which runs again; and the logs of both controllers."""
    folder = ran(2).folder
    assert {path.name for path in ran(1).folder.iterdir()} == {path.name for path in folder.iterdir()}
    assert "household" in load(folder).applications
    for number in (1, 2):
        assert (folder / "logs" / f"shard-{number}" / "controller.log").is_file()


@pytest.mark.long
def test_a_loop_with_a_solver_is_made_one(tmp_path: Path) -> None:
    """Solvers stay in the processes that have them, and what they decided is what they decide in memory."""
    pytest.importorskip("osqp", reason="model predictive control needs the extra `microgrid`")
    scenario = part_of_day("microgrid-mpc", 43_200, 130, trials=2, eavesdroppers__bayesian__strategy="smart")
    sharded = run(scenario, out=tmp_path / "shards", shards=2).summary
    memory = montecarlo(scenario, out=tmp_path / "memory", trials=2).summary
    assert sharded["controller"]["digest"] == memory["controller"]["digest"] is not None
    assert sharded["household"] == memory["household"]


@pytest.mark.long
@pytest.mark.parametrize("name", ["controller", "recorder"])
def test_a_loop_that_is_cut_short_is_made_one(evedrop: Evedrop, name: str) -> None:
    """Inputs, and the metrics of controller and house, as far as each shard came, or as its recorder had written them."""
    words = ("--trials", "5", "--set", "shards=2", "--set", "expect=[]", "--set", f"record_trials={RECORDED}")
    live = evedrop.live("microgrid", *words)
    wait_until(lambda: all(last_round(live.folder / "shards" / shard).slots > 100 for shard in "12"), "slots on disk")
    os.kill(child(live, 2, name), signal.SIGKILL)
    done = live.end()
    assert done.status == 3
    assert f"shard 2 (trials 2 to 4): {name} was ended by signal 9" in done.err
    live.nothing_left()
    assert not (live.folder / "shards").exists()
    counts = set(live.results.slots["trials"].to_pylist())
    assert counts <= {2, 3, 5}
    assert live.results.inputs is not None
    recorded = set(live.results.inputs["trial"].to_pylist())
    assert recorded == set(range(RECORDED))
    assert live.results.inputs.num_rows == live.results.trials.num_rows / len(load("microgrid").receivers)
    summary = live.results.summary
    assert summary["controller"]["digest"] is None
    assert summary["controller"]["decisions"] > 0
    assert summary["household"]["net_difference"] >= 0.0
    # An energy is of as many slots in every trial.
    assert (summary["household"]["bought_energy"] is None) is (counts != {5})


@pytest.mark.long
def test_a_killed_router_of_a_shard_is_started_again(evedrop: Evedrop, tmp_path: Path) -> None:
    """The run ends with the digests of an undisturbed one, and says which shard was cut off, as it goes on and at the end."""
    options = {"trials": 5, "slots": 1500, "pace": 0.001, "shards": 2, "expect": []}
    words = [word for key, value in options.items() for word in ("--set", f"{key}={value}")]
    live = evedrop.live("eavesdroppers", *words)
    live.running(more_than=100)
    os.kill(child(live, 2, "router"), signal.SIGKILL)
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()
    summary = live.results.summary
    as_if_undisturbed(summary, load("eavesdroppers", options), tmp_path / "memory")
    (outage,) = summary["outages"]
    assert (outage["shard"], outage["process"]) == (2, "router")
    assert 0 < outage["slot"] <= outage["until"]
    assert "router of shard 2 cut off at slot" in done.out + done.err
