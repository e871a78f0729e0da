"""A run with a μ_d for each slot: the same bits live and in memory, theory for every slot, and mistakes that are refused."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import montecarlo, run
from evedrop.cli.api import design, design_schedule
from evedrop.errors import BriefError, ScenarioError, UsageError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import read_brief
from evedrop.scenario.loading import checked
from evedrop.scenario.theory import expectations_of
from evedrop.score.secrecy import Claim
from tests.builders import UNSTABLE, digests_of, process_table

MU_D = [1, 0.0, 0.0, 0.3, 0.3, 0.9, 1, 0.2]
READERS: dict[str, dict[str, Any]] = {
    "smart": {},
    "genie": {},
    "bayesian": {},
    "likelihood": {},
    "suspicious": {"use_state": 0.8, "use_innovation": 0.3},
}


def tables_of(**more: Any) -> dict[str, Any]:
    """A scenario with a list of μ_d and all eavesdroppers that know it."""
    return {
        "title": "A schedule",
        "slots": len(MU_D),
        "trials": 4,
        "process": process_table(UNSTABLE),
        "encoding": {"scheme": "innovation", "state_probability": MU_D},
        "legitimate": {"link": {"quality": 0.9}},
        "eavesdroppers": {
            name: {"strategy": name, "link": {"quality": 0.85}, **parameters} for name, parameters in READERS.items()
        },
        **more,
    }


@pytest.mark.thorough
def test_live_and_memory_agree(tmp_path: Path) -> None:
    """All digests are equal, and the resolved scenario keeps the list."""
    scenario = checked(tables_of(), "it")
    live = run(scenario, out=tmp_path / "live")
    memory = montecarlo(scenario, out=tmp_path / "memory", trials=4)
    assert digests_of(live) == digests_of(memory)
    assert all(digests_of(live).values())
    again = montecarlo(tmp_path / "live", out=tmp_path / "again", trials=4)
    assert digests_of(again) == digests_of(live)


@pytest.mark.long
def test_means_agree_with_theory(tmp_path: Path) -> None:
    """Mean errors over many trials are within 4.5 standard errors of theory, in a mode that only follows events too."""
    tables = tables_of(
        trials=2000,
        process={**process_table(UNSTABLE), "initial_covariance": [[1e-3, 0.0], [0.0, 1e-3]]},
        eavesdroppers={name: tables_of()["eavesdroppers"][name] for name in ("smart", "genie", "suspicious")},
    )
    result = montecarlo(checked(tables, "it"), out=tmp_path / "it", trials=2000)
    for name, peer in result.summary["peers"].items():
        assert abs(peer["z"]["mean_squared_error"]) < 4.5, name
    verdict = result.summary["secrecy"]["suspicious"]
    assert (verdict["relative_by_theory"], verdict["perfect_by_theory"]) == (True, None)
    assert verdict["perfect"] == Claim.UNDECIDED.value


def test_what_needs_a_constant_probability_says_nothing() -> None:
    """There is no limit and no statement on tails; the genie bounds the readers whose error has no closed form."""
    expectations = expectations_of(checked(tables_of(), "it"))
    for name, expectation in expectations.items():
        assert math.isnan(expectation.limit)
        assert not expectation.infinite_variance
        assert (expectation.streaks(len(MU_D)) is not None) == expectation.known
        assert expectation.known == (name not in ("bayesian", "likelihood"))
    bound = expectations["bayesian"].bound
    assert bound is not None
    assert np.array_equal(bound.traces(8), expectations["genie"].traces(8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slots": 9}, "has 8 numbers; expected one number for each of the 9 slots, or a single number for all"),
        ({"encoding": {"scheme": "innovation", "state_probability": []}}, "is an empty list"),
        ({"encoding": {"scheme": "innovation", "state_probability": [0.5, 2]}}, "is 2 for slot 1; expected"),
        ({"encoding": {"scheme": "withholding", "state_probability": [0.5] * 8}}, "expected a number from 0 to 1"),
    ],
)
def test_refusals(changes: dict[str, Any], message: str) -> None:
    """A list of the wrong length or with wrong numbers is refused, and a scheme that takes none."""
    with pytest.raises(ScenarioError, match=re.escape(message)):
        checked(tables_of(**changes), "it")


def test_the_design_of_one_probability_refuses_a_list() -> None:
    """It names the remedy; the design of a schedule does not need the scenario's own."""
    scenario = checked(tables_of(eavesdroppers={"smart": tables_of()["eavesdroppers"]["smart"]}), "it")
    with pytest.raises(UsageError, match=r"change it, as by encoding\.state_probability=0\.6"):
        design(scenario)
    assert design_schedule(scenario, 3, weight=0.5).schedules["smart"].best.mu_d[0] == 1.0


@pytest.mark.parametrize("wrong", [[0.5] * 7, [0.5] * 7 + [1.5], 0.5])
def test_a_brief_with_other_numbers_is_refused(wrong: object, tmp_path: Path) -> None:
    """A process refuses a list that is not one probability for each slot."""
    made = briefs_of(
        checked(tables_of(), "it"), endpoints_at("tcp/127.0.0.1:1"), RecorderTask(tmp_path / "results", False)
    )["smart"]
    path = made.write(tmp_path)
    assert read_brief(path).model.state_probabilities == tuple(MU_D)
    table = json.loads(path.read_text())
    table["model"]["state_probabilities"] = wrong
    path.write_text(json.dumps(table))
    with pytest.raises(BriefError, match="state_probabilities"):
        read_brief(path)
