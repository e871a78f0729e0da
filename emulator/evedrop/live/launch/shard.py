"""A shard of a run: a contiguous range of its trials, with a scenario and a results folder of its own.

Source: docs/scale.md.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from evedrop.scenario.tables import Scenario

SHARDS_FOLDER = "shards"  # in the results folder, until the shards are merged


@dataclass(frozen=True)
class Shard:
    """A range of the trials of a run."""

    number: int
    """Number of the shard, from 1 on, in order of trials."""
    scenario: Scenario
    """The run's scenario, with only these trials."""
    folder: Path
    """Its own results folder."""

    @property
    def name(self) -> str:
        """Name of the folder of its logs, in the run's log folder."""
        return f"shard-{self.number}"

    @property
    def trials(self) -> range:
        """The shard's trials, by their numbers in the scenario."""
        first = self.scenario.first_trial
        return range(first, first + self.scenario.trials)

    def of_run(self, text: object) -> str:
        """A message of the shard as one of the run: names the shard, and its logs by their path in the run's folder."""
        trials = self.trials
        which = f"trial {trials[0]}" if len(trials) == 1 else f"trials {trials[0]} to {trials[-1]}"
        return f"shard {self.number} ({which}): " + re.sub(r"(?<![\w/])logs/", f"logs/{self.name}/", str(text))


def shards_of(scenario: Scenario, folder: Path) -> list[Shard]:
    """The shards of a run, as equal as possible; a shard without a recorded trial records its first trial nevertheless."""
    trials, recorded, count = scenario.trials, scenario.record_trials, scenario.shards
    bounds = [trials * i // count for i in range(count + 1)]
    tables = scenario.model_dump(mode="json")
    made = []
    for number, start in enumerate(bounds[:-1], 1):
        own = {
            "trials": bounds[number] - start,
            "first_trial": scenario.first_trial + start,
            "record_trials": max(1, min(recorded - start, bounds[number] - start)),
            "shards": 1,
        }
        made.append(Shard(number, Scenario.model_validate({**tables, **own}), folder / SHARDS_FOLDER / str(number)))
    return made
