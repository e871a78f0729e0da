"""The mistake of a run that float64 cannot follow: what is proposed is possible."""

from __future__ import annotations

import re

import pytest

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import load


@pytest.mark.parametrize(
    ("initial", "noise"), [(1e100, 1e-3), (1.0, 1e-100), (1.0, 1e-28), (1e24, 1e-3), (1e20, 1e-3), (1.0, 1e-3)]
)
def test_the_number_of_slots_that_is_proposed_can_be_run(initial: float, noise: float) -> None:
    """And none is proposed where not even slot 0 can be followed; then the initial covariance that is proposed helps."""
    changes = {
        "slots": 400,
        "process.initial_covariance": [[initial, 0.0], [0.0, initial]],
        "process.Q": [[noise, 0.0], [0.0, noise]],
        "expect": [],
    }
    with pytest.raises(ScenarioError) as raised:
        load("numerical", changes)
    (mistake,) = raised.value.mistakes
    assert "slot -" not in mistake
    proposed = re.search(r"slots = (\d+)", mistake)
    if proposed is None:
        assert "cannot be followed in any slot" in mistake
        assert initial > 8e27 * noise
        smaller = [[7e27 * noise, 0.0], [0.0, 7e27 * noise]]
        load("numerical", {**changes, "slots": 1, "process.initial_covariance": smaller})
    else:
        assert int(proposed[1]) >= 1
        load("numerical", {**changes, "slots": int(proposed[1])})
