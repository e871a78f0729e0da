"""What a shard of a run has kept of its trials, left beside its tables for whoever judges the run as a whole.

It never leaves the machine or the user: a pickle, written by one process of a run and read by another, then removed.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emulator.runs.acknowledging import Detection
from emulator.runs.score import Tally, merged
from emulator.runs.watched import Watched, watches_of
from emulator.scenario import Scenario

_NAME = "score"


@dataclass(frozen=True)
class Score:
    """The totals of some trials."""

    tallies: Mapping[str, Tally]
    """By receiver."""
    detection: Detection

    @classmethod
    def nothing(cls, scenario: Scenario) -> Score:
        """Of trials that have come to no slot."""
        trials = scenario.trials
        tallies = {
            name: Tally(scenario.slots, trials, Watched(watches, trials))
            for name, watches in watches_of(scenario).items()
        }
        return cls(tallies, Detection(trials))

    @classmethod
    def merged(cls, parts: Sequence[Score]) -> Score:
        """Of disjoint sets of trials, in their order."""
        tallies = {
            name: merged({number: part.tallies[name] for number, part in enumerate(parts)}) for name in parts[0].tallies
        }
        return cls(tallies, Detection.merged([part.detection for part in parts]))

    def leave(self, folder: Path) -> None:
        """Write it into a results folder, whole at any moment and for nobody else to read or change."""
        unfinished = folder / f"{_NAME}.new"
        with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            pickle.dump(self, file)
        os.replace(unfinished, folder / _NAME)

    @classmethod
    def left(cls, folder: Path, scenario: Scenario) -> Score:
        """The one in a results folder; that of nothing, where whoever should have left it was killed before."""
        try:
            with (folder / _NAME).open("rb") as file:
                found: Score = pickle.load(file)  # noqa: S301 - a process of this run has written it, into a folder of ours
        except (OSError, EOFError, pickle.UnpicklingError):
            return cls.nothing(scenario)
        return found
