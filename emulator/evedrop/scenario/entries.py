"""The keywords of `Scenario(...)`, for editors and type checkers.

They know only keywords that are written down, so the names of the fields of `Scenario` stand here again, with the types of the
values before the checks.

Source: docs/python.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

Entries = Mapping[str, Any]
"""A table, as a dict."""


class ScenarioEntries(TypedDict, total=False):
    """The entries of a scenario as Python values, for editors and type checkers; docs/scenario.md describes each."""

    title: str
    slots: int
    seed: int
    trials: int
    first_trial: int
    record_trials: int
    shards: int
    pace: float
    longest_outage: float
    slot_seconds: float | None
    secret_file: str | Path | None
    modules: str | Path | None
    process: Entries
    encoding: Entries
    legitimate: Entries
    eavesdroppers: Mapping[str, Entries]
    plant: Entries | None
    controller: Entries | None
    acknowledgements: Entries | None
    energy: Entries | None
    wire: Entries | None
    network: Entries | None
    event: Sequence[Entries]
    nemesis: Entries | None
    expect: Sequence[Entries]
