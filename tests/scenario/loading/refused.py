"""A scenario that is refused, and the message."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.errors import ScenarioError
from evedrop.scenario.loading import parse

BASE = """
title = "Refused"
slots = 50
[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
scheme = "innovation"
state_probability = 0.5
[legitimate]
link = { quality = 0.9 }
"""


def mistakes(text: str, folder: Path = Path()) -> list[str]:
    """What is said of a scenario."""
    with pytest.raises(ScenarioError) as caught:
        parse(text, "scenario.toml", folder=folder)
    assert caught.value.exit_status == 2
    return caught.value.mistakes
