"""How much learners know, and what their errors are: against a Monte Carlo study of the same trials, and by the command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.cli.api import montecarlo
from evedrop.errors import UsageError
from evedrop.scenario.loading import load
from evedrop.simulate.montecarlo import Plan
from evedrop.studies.learning_curve import learning_curve
from tests.conftest import Evedrop

SLOTS, TRIALS = 24, 5
SMALL: dict[str, Any] = {"slots": SLOTS, "trials": TRIALS, "expect": [], "eavesdroppers.learning.keeps": 16}


def test_errors_are_those_of_a_study_of_the_same_trials(tmp_path: Path) -> None:
    """The rows' errors, weighted by their slots, are the study's mean; a shorter study has the same first row."""
    rows = learning_curve(load("learning", SMALL), lambda _: None)
    assert [(row.first, row.stop) for row in rows] == [(0, 8), (8, 16), (16, 24)]
    options: dict[str, Any] = {"expect": [], "slots": SLOTS, "trials": TRIALS, "eavesdroppers__learning__keeps": 16}
    study = montecarlo("learning", out=tmp_path / "study", plan=Plan(workers=1), **options)
    for name, metrics in study.summary["peers"].items():
        mean = sum(row.errors[name] * (row.stop - row.first) for row in rows) / SLOTS
        assert mean == pytest.approx(metrics["mean_squared_error"], rel=1e-12)
    (curve_row,) = learning_curve(load("learning", {**SMALL, "slots": 8}), lambda _: None)
    assert curve_row == rows[0]
    last = rows[-1]
    for name, of in last.ratios["learning"].items():
        assert of.ratio == pytest.approx(last.errors["learning"] / last.errors[name])
    assert last.ratios["learning"].keys() == {"bayesian", "smart", "constant"}


def test_before_it_has_learned_the_errors_are_those_of_its_start() -> None:
    """After eight slots A is I and μ_d 1/2, in all trials: errors that can be computed by hand."""
    done: list[int] = []
    row = learning_curve(load("learning", SMALL), done.append)[0]
    assert sum(done) == SLOTS * TRIALS
    A = np.array([[0.95, 0.1], [-0.1, 0.9]])
    off = row.parameters["learning"]
    assert off["A"].median == pytest.approx(np.linalg.norm(np.eye(2) - A) / np.linalg.norm(A))
    assert off["A"].mean == pytest.approx(off["A"].median)
    assert off["mu_d"].median == pytest.approx(1.0 / 6.0)
    assert off["mu_d"].standard_error == pytest.approx(0.0, abs=1e-15)
    assert off["Q"].standard_error is not None


@pytest.mark.long
def test_sets_of_trials_side_by_side_change_nothing() -> None:
    """The same rows with two trials at a time."""
    scenario = load("learning", SMALL)
    whole = learning_curve(scenario, lambda _: None)
    assert learning_curve(scenario, lambda _: None, side_by_side=2) == whole


def test_somebody_has_to_learn() -> None:
    """A scenario without a learner is refused, with the name of one that has one."""
    with pytest.raises(UsageError, match="no eavesdropper learns; try the scenario learning"):
        learning_curve(load("numerical", {"slots": 10, "trials": 1}), lambda _: None)


def test_the_command(evedrop: Evedrop) -> None:
    """It prints both tables, or a row for each number of slots as JSON; a single trial has no standard error."""
    arguments = ("learned", "learning", "--slots", "12", "--set", "expect=[]")
    done = evedrop(*arguments, "--trials", "1")
    assert done.status == 0, done.err
    assert "learning / it" in done.out
    assert re.search(r"^ *8 +learning .* 0.167 +0.167 *$", done.out, re.MULTILINE)
    rows = json.loads(evedrop(*arguments, "--trials", "2", "--json").out)
    assert [row["stop"] for row in rows] == [8, 12]
    assert rows[0]["parameters"]["learning"]["mu_d"]["mean"] == pytest.approx(1.0 / 6.0)
