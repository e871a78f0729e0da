"""Scenarios that are made in Python: the same checks as for a file, and the same messages.

Source: docs/python.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evedrop.errors import ScenarioError
from evedrop.scenario.arguments import path_argument
from evedrop.scenario.loading.file import checked, load, located
from evedrop.scenario.loading.python_values import plain_tables
from evedrop.scenario.tables import Builders, Scenario
from evedrop.scenario.values import unusable

_SOURCE = "Scenario"


def built(values: Mapping[str, Any]) -> Scenario:
    """The scenario with these entries; files that it names are in the current folder.

    Whether double precision can follow the process for that many slots is checked when the scenario is used.

    Raises ScenarioError with every mistake.
    """
    tables = plain_tables(values, _SOURCE)
    if mistakes := list(unusable(tables)):
        raise ScenarioError(_SOURCE, mistakes)
    located(tables, Path())
    return checked(tables, _SOURCE, beyond_horizon=True)


def loaded(source: str | Path, changes: Mapping[str, Any]) -> Scenario:
    """A built-in scenario or a file, with changes by dotted key. Raises ScenarioError with every mistake."""
    return prepared(source, changes, beyond_horizon=True)


def prepared(scenario: str | Path | Scenario, changes: Mapping[str, Any], *, beyond_horizon: bool = False) -> Scenario:
    """The scenario that a call is about, with changes by dotted key, checked as `load` does; beyond_horizon: as there.

    Raises ScenarioError with every mistake, UsageError for what is neither a Scenario nor the name of one.
    """
    if isinstance(scenario, Scenario):
        return changed(scenario, changes, beyond_horizon=beyond_horizon)
    path_argument(
        "scenario", scenario, "a built-in name, a file, or a Scenario, which Scenario(entries) makes of a dict"
    )
    return load(scenario, plain_tables(changes, str(scenario)), beyond_horizon=beyond_horizon)


def changed(scenario: Scenario, changes: Mapping[str, Any], *, beyond_horizon: bool = True) -> Scenario:
    """The scenario with changes by dotted key; None removes an entry. Raises ScenarioError with every mistake."""
    tables = scenario.as_tables()
    for key in [key for key, value in changes.items() if value is None]:
        *above, last = key.split(".")
        inner: Any = tables
        for name in above:
            inner = inner.get(name, {}) if isinstance(inner, dict) else {}
        if isinstance(inner, dict):
            inner.pop(last, None)
    made = plain_tables(changes, scenario.title, scenario.modules)
    return checked(tables, scenario.title, made, beyond_horizon=beyond_horizon)


def register() -> None:
    """Let `Scenario(...)`, `Scenario.load` and `replace` check whole scenarios."""
    Scenario.builders = Builders(built, loaded, changed)
