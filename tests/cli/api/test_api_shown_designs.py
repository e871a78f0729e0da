"""Designs that Python shows as the command prints them."""

from __future__ import annotations

from evedrop import Scenario, design, design_budget, design_policy, design_schedule
from evedrop.model.theory.design import Design
from evedrop.model.theory.schedules import ScheduleDesign
from evedrop.scenario.designs import BudgetDesign, PolicyDesign
from tests.builders import GOOD


def test_a_design_begins_with_its_answer() -> None:
    """In lines of 100 characters; its numbers are still attributes."""
    designed = design("numerical")
    assert isinstance(designed, Design)
    lines = repr(designed).splitlines()
    assert lines[0].startswith("choose μ_d = ")
    assert {line.split()[0] for line in lines} >= {"admissible:", "against", *designed.eavesdroppers}
    assert max(map(len, lines)) <= 100
    assert designed.mu_d == 0.56


def test_other_designs_are_shown_as_the_command_prints_them() -> None:
    """A table for each adversary, with a sentence above it."""
    small = Scenario(GOOD)
    schedules = design_schedule(small, 3, weight=0.5)
    assert isinstance(schedules, ScheduleDesign)
    assert repr(schedules).startswith("against smart: the sum is ")
    assert "slot   μ_d   legitimate error" in repr(schedules)
    reference = {"strategy": "naive", "link": {"quality": 0.8}}
    acknowledged = small.replace(
        encoding={"scheme": "scheduled", "threshold": 3},
        acknowledgements={"link": {"quality": 0.9}},
        eavesdroppers={"near": reference},
    )
    policies = design_policy(acknowledged, weights=[0.5], states=4)
    assert isinstance(policies, PolicyDesign)
    assert repr(policies).startswith("legitimate link quality μ = ")
    assert "against near" in repr(policies)
    quantised = small.replace(
        process={"A": [[0.9]], "Q": [[1.0]], "initial_covariance": [[1.0]]},
        encoding={"scheme": "quantised-schedule", "threshold": 2.0, "bits": 8, "standard_deviations": 6.0},
        eavesdroppers={"listener": {"strategy": "selective", "link": {"quality": 0.8}}},
        acknowledgements={"link": {"quality": 0.9}},
        energy={"packet": 1.0, "encryption": 0.5},
    )
    budget = design_budget(quantised, 1.3)
    assert isinstance(budget, BudgetDesign)
    assert repr(budget).startswith("an unencrypted packet costs 1, an encrypted one 1.5")
