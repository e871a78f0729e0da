"""The memory that scoring takes does not grow with the slots of a run: a recorder scores runs of any length."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest

from evedrop.scenario.loading import load
from evedrop.score.scorekeeper import RunOutcome, Scorekeeper, summary_of

SCENARIO: dict[str, Any] = {"process.directions": {"position": [1.0, 0.0]}, "expect": []}
MEGABYTES = 4.0
"""More than a part of the slots needs that is computed at once, and less than three numbers of each of SLOTS slots."""
SLOTS = 200_000


def peak_of(work: Callable[[], object]) -> float:
    """The most MB that were in use at a time, beyond those at the beginning."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def test_what_is_expected_of_a_long_run_is_not_stored() -> None:
    """Neither theory's errors nor the bits that packets reveal: a number for each slot would be 8 MB for each receiver."""
    scenario = load("eavesdroppers", {"slots": 1_000_000, **SCENARIO})
    assert peak_of(lambda: Scorekeeper(scenario, 1)) < 1.0


@pytest.mark.long
def test_a_summary_does_not_take_more_memory_the_longer_the_run() -> None:
    """A recorder makes one every few seconds, and what it has taken it may never give back."""
    scenario = load("eavesdroppers", {"slots": 10 * SLOTS, **SCENARIO})
    run_tally, digests = Scorekeeper(scenario, 1).run_tally, dict.fromkeys(scenario.receivers)

    def summarise(done: int) -> None:
        for tally in run_tally.tallies.values():
            tally.done = tally.offered = done
            for direction in tally.directions.values():
                direction.reached[:] = done
        summary_of(scenario, run_tally, digests, RunOutcome(1.0, f"slot {done}"))

    summarise(100)  # which imports what a summary needs
    assert peak_of(lambda: summarise(SLOTS)) < MEGABYTES
