"""A scheme in a module of its own states its closed form, and the commands take it as that of a built-in scheme."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.cli.api import design_policy
from evedrop.errors import UsageError
from evedrop.scenario.loading import load
from evedrop.scenario.theory import expectations_of

MODULE = """
from evedrop.extend import ClosedForm, Plain, ReceiverConditions
import numpy as np


class Level(ClosedForm):
    infinite_variance = False

    def __init__(self, error, slots):
        self.error, self.slots = error, slots

    @property
    def limit(self):
        return self.error

    @property
    def traces(self):
        return np.full(self.slots, self.error)


def level(scheme, conditions: ReceiverConditions):
    if conditions.acknowledged is None:
        return None
    return Level(scheme.process.n / conditions.received, conditions.slots)


class Resting(Plain):
    needs_acknowledgements = True
    closed_forms = {"legitimate": level, "naive": level}
    sends_by_holding_time = True


class Silent(Resting):
    pass
"""
SCENARIO = """
title = "A scheme of its own"
slots = 7
trials = 2
process = { A = [[1.0, 0.3], [0.5, 1.001]], Q = [[1e-3, 0.0], [0.0, 1e-3]], initial_covariance = [[1e-3, 0.0], [0.0, 1e-3]] }
encoding = { scheme = "resting_schemes:Resting" }
acknowledgements = { link = { quality = 0.9 } }
legitimate = { link = { quality = 0.8 } }
eavesdroppers = { near = { strategy = "naive", link = { quality = 0.5 } } }
"""


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    """The file of the scenario, with the module in its folder."""
    (tmp_path / "resting_schemes.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "resting.toml").write_text(SCENARIO, encoding="utf-8")
    return str(tmp_path / "resting.toml")


def test_theory_and_design_take_a_closed_form_of_ones_own(scenario: str) -> None:
    """Its errors are theory's; `design --policy` takes the scheme. A subclass that does not repeat the statements is refused."""
    expectations = expectations_of(load(scenario))
    assert {
        name: (expectation.limit, expectation.traces(7).tolist()) for name, expectation in expectations.items()
    } == {
        "legitimate": (2.5, [2.5] * 7),
        "near": (4.0, [4.0] * 7),
    }
    assert list(design_policy(scenario, weights=[0.9], prices=[0.0], states=3).fronts) == ["near"]
    with pytest.raises(UsageError, match="resting_schemes:Silent"):
        design_policy(scenario, changes={"encoding.scheme": "resting_schemes:Silent"})
