"""Which figures of a live run were verified, and which rest on a receiver's own report.

Source: docs/results.md, what is verified.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise

from evedrop.figures import figures_of
from evedrop.scenario import Scenario
from evedrop.score.summary import Verification


def verification_of(scenario: Scenario, accused: Collection[str] = ()) -> dict[str, Verification]:
    """The entry `verification` of a live run's summary: receiver → the verified figures, and those that rest on its word.

    accused: processes whose misbehaviour ended the run.
    """
    recorded = _recorded_of(scenario)
    found = {}
    for name in scenario.receivers:
        figures = {who: _resting_on(who, name) for who in ("observer", "receiver", "recorded trials")}
        checked, of_recorded = figures["observer"], [*figures["recorded trials"], "digest"]
        verified = [] if name in accused else checked + (of_recorded if recorded == scenario.trials else [])
        own_word = [one for one in (*checked, *figures["receiver"], *of_recorded) if one not in verified]
        found[name] = Verification(0 if name in accused else recorded, verified, own_word)
    return found


def _resting_on(who: str, receiver: str) -> list[str]:
    """The figures of a receiver of a live run with this value of `rests_on`."""
    figures = figures_of(receiver).items()
    return [name for name, one in figures if one.rests_on == who and one.only_in_mode is None]


def _recorded_of(scenario: Scenario) -> int:
    """The number of recorded trials; each shard records at least its first."""
    bounds = [scenario.trials * i // scenario.shards for i in range(scenario.shards + 1)]
    return sum(max(1, min(scenario.record_trials, stop) - start) for start, stop in pairwise(bounds))
