"""A scenario without mistakes, and the messages if it has one."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import tomli_w

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import parse

GOOD: dict[str, Any] = {
    "title": "A vehicle",
    "slots": 50,
    "process": {
        "A": [[1.0, 0.1], [0.0, 1.0]],
        "Q": [[1e-3, 0.0], [0.0, 1e-3]],
        "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
    },
    "encoding": {"scheme": "innovation", "state_probability": 0.5},
    "legitimate": {"link": {"quality": 0.9}},
    "eavesdroppers": {"smart": {"strategy": "smart", "link": {"quality": 0.8}}},
}


def mistakes(changes: dict[str, Any], without: str = "") -> list[str]:
    """The messages about the good scenario with these changes, and without one entry."""
    tables = copy.deepcopy(GOOD)
    *above, last = without.split(".")
    inner = tables
    for name in above:
        inner = inner[name]
    if without:
        del inner[last]
    with pytest.raises(ScenarioError) as caught:
        parse(tomli_w.dumps(tables), "scenario", changes)
    assert caught.value.exit_status == 2
    return caught.value.mistakes
