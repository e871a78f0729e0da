"""The totals of a shard's trials, stored with its tables for the process that scores the whole run.

They never leave the machine or the user: a pickle, written by one process of a run, read by another, then removed.
"""

from __future__ import annotations

import pickle
from pathlib import Path

from evedrop.results.folder import private_replacement
from evedrop.scenario import Scenario
from evedrop.score.totals import Totals

_NAME = "score"


def dump_score(totals: Totals, folder: Path) -> None:
    """Write the totals to a results folder; the file is complete at any moment, and private to this user. Raises OSError."""
    with private_replacement(folder / _NAME) as unfinished, unfinished.open("wb") as file:
        pickle.dump(totals, file)


def load_score(folder: Path, scenario: Scenario) -> Totals:
    """Read the totals from a results folder; empty totals if the process that should have written them was killed."""
    try:
        with (folder / _NAME).open("rb") as file:
            found: Totals = pickle.load(file)  # noqa: S301 - written by a process of this run, in a folder of this user
    except (OSError, EOFError, pickle.UnpicklingError):
        return Totals.nothing(scenario, scenario.trials)
    return found
