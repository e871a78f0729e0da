"""Which figures of a live run were verified, and which rest on a receiver's own report.

Source: docs/results.md, what is verified.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from typing import Any

from evedrop.scenario import Scenario


def verification_of(scenario: Scenario, accused: Collection[str] = ()) -> dict[str, Any]:
    """The entry `verification` of a live run's summary: receiver → the verified figures, and those that it only reported.

    accused: processes whose reports made the run end.
    """
    recorded = _recorded_of(scenario)
    checked, of_recorded = ["mean_squared_error", "received_fraction"], ["mean_trace_covariance", "digest"]
    found = {}
    for name in scenario.receivers:
        figures = [] if name in accused else checked + (of_recorded if recorded == scenario.trials else [])
        own_word = [one for one in (*checked, "used_fraction", *of_recorded) if one not in figures]
        found[name] = {
            "recomputed_trials": 0 if name in accused else recorded,
            "verified": figures,
            "own_word": own_word,
        }
    return found


def _recorded_of(scenario: Scenario) -> int:
    """The number of recorded trials; each shard records at least its first."""
    bounds = [scenario.trials * i // scenario.shards for i in range(scenario.shards + 1)]
    return sum(max(1, min(scenario.record_trials, stop) - start) for start, stop in pairwise(bounds))
