"""What a shard of a run has kept of its trials, left beside its tables for whoever judges the run as a whole.

It never leaves the machine or the user: a pickle, written by one process of a run and read by another, then removed.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path

from evedrop.scenario import Scenario
from evedrop.score.totals import Totals

_NAME = "score"


def dump_score(totals: Totals, folder: Path) -> None:
    """Write them into a results folder, whole at any moment and for nobody else to read or change."""
    unfinished = folder / f"{_NAME}.new"
    with os.fdopen(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        pickle.dump(totals, file)
    os.replace(unfinished, folder / _NAME)


def load_score(folder: Path, scenario: Scenario) -> Totals:
    """Those in a results folder; of nothing, where whoever should have left them was killed before."""
    try:
        with (folder / _NAME).open("rb") as file:
            found: Totals = pickle.load(file)  # noqa: S301 - a process of this run has written it, into a folder of ours
    except (OSError, EOFError, pickle.UnpicklingError):
        return Totals.nothing(scenario, scenario.trials)
    return found
