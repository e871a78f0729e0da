"""Monte Carlo: the trials of a live run in memory, the same bits without a network.

Trials run in fixed blocks of 500, whatever their number, and are merged in trial order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from emulator.model.digest import RunDigest
from emulator.run.results import ResultsWriter, new_folder, write_summary
from emulator.run.score import SlotSums, Tally, merged
from emulator.run.scorekeeper import Ending, Scorekeeper, resolved, summary_of
from emulator.run.simulation import Simulation
from emulator.scenario import Scenario

BLOCK_TRIALS = 500


def simulate(scenario: Scenario, folder: Path, tell: Callable[[Mapping[str, Any]], None]) -> int:
    """Run all trials of a scenario into a results folder; the exit status. `tell` gets progress as it is made."""
    new_folder(folder)
    started = time.monotonic()
    (folder / "scenario.toml").write_text(resolved(scenario))
    names, slots = scenario.receivers, scenario.slots
    sums = {name: SlotSums.zero(slots) for name in names}
    tallies: dict[str, dict[int, Tally]] = {name: {} for name in names}
    digests = {name: RunDigest() for name in names}
    end = scenario.first_trial + scenario.trials
    with ResultsWriter(folder, names, len(scenario.process.A)) as writer:
        for start in range(scenario.first_trial, end, BLOCK_TRIALS):
            trials = range(start, min(start + BLOCK_TRIALS, end))
            recorded = max(0, min(scenario.first_trial + scenario.record_trials, trials.stop) - start)
            simulation = Simulation(scenario, trials, recorded)
            keeper = Scorekeeper(scenario, len(trials))
            for chunk in simulation.chunks():
                scored = keeper.add(chunk)
                for name, one in scored.items():
                    sums[name].add(chunk.first, one.sums)
                if recorded:
                    writer.trial_rows(chunk, {name: one.squared_error for name, one in scored.items()}, start)
                done = (start - scenario.first_trial) * slots + len(trials) * (chunk.first + chunk.count)
                rate = done / (time.monotonic() - started)
                tell({"event": "progress", "done": done, "rate": rate, "rate_unit": "trial-slots/s"})
            writer.digest_rows(start, simulation.digests)
            for name in names:
                tallies[name][start] = keeper.tallies[name]
                digests[name].add(simulation.digests[name])
        theory = Scorekeeper(scenario, 1).expected(slots)
        for name in names:
            writer.slot_rows(0, name, sums[name], theory[name])
    totals = {name: merged(tallies[name]) for name in names}
    ending = Ending(time.monotonic() - started)
    summary = summary_of(scenario, totals, {name: digests[name].hexadecimal for name in names}, ending)
    write_summary(folder, summary)
    return 0 if all(expectation["held"] for expectation in summary["expectations"]) else 1
