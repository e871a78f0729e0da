"""The command that measures what cannot be designed."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evedrop.model.checks import toml_of
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import dotted


def measuring_command(given: str | Path | Scenario, changes: Mapping[str, Any], made: Scenario) -> str:
    """A command that simulates the scenario: over a grid of μ_d if it has one μ_d, otherwise as it is.

    given: the scenario as the caller named it; a Scenario, which has no name, is called SCENARIO; changes: those of the call;
    made: the scenario with these changes.
    """
    mu_d = made.encoding.parameters.get("state_probability")
    constant = isinstance(mu_d, (int, float))
    words = [
        "evedrop",
        "sweep" if constant else "montecarlo",
        "SCENARIO" if isinstance(given, Scenario) else str(given),
    ]
    for key, value in dotted(changes).items():
        words += ["--set", f"{key}={toml_of(value)}"]
    if constant:
        words += ["--over", "encoding.state_probability=0.1:0.9:0.1"]
    return shlex.join(words)
