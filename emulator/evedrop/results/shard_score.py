"""The tally of a shard's trials, stored with its tables for the process that scores the whole run.

They never leave the machine or the user: written by one process of a run, read by another, then removed. They are data
(`evedrop.results.object_data`), which cannot run code where they are read.
"""

from __future__ import annotations

from pathlib import Path

from evedrop.errors import RunError
from evedrop.results.folder import private_replacement
from evedrop.results.object_data import NotData, packed, unpacked
from evedrop.scenario.tables import Scenario
from evedrop.score.run_tally import RunTally

_NAME = "score"


def dump_score(run_tally: RunTally, folder: Path, scenario: Scenario) -> None:
    """Write the tally to a results folder; the file is complete at any moment, and private to this user.

    scenario: that of the shard. The metric of a package whose tally is not data fails, which the tally then says.

    Raises OSError.
    """
    example = _example(scenario)
    for name, tally in run_tally.tallies.items():
        blank = example.tallies[name].watched.of_packages
        for watch, kept in tally.watched.of_packages.items():
            try:
                unpacked(packed(kept), blank[watch])
            except NotData as error:
                kept.fail(
                    f"a shard cannot store its tally ({error}); docs/your-own.md says what a tally may consist of"
                )
    with private_replacement(folder / _NAME) as unfinished:
        unfinished.write_bytes(packed(run_tally))


def load_score(folder: Path, scenario: Scenario) -> RunTally:
    """Read the tally from a results folder; an empty one if the process that should have written it was killed.

    scenario: that of the shard. Raises RunError if it is damaged.
    """
    try:
        data = (folder / _NAME).read_bytes()
    except OSError:
        return RunTally.nothing(scenario, scenario.trials)
    try:
        run_tally = unpacked(data, _example(scenario))
    except NotData as error:
        raise RunError(f"{folder / _NAME} is damaged ({error}); run again") from error
    if not isinstance(run_tally, RunTally):
        raise RunError(f"{folder / _NAME} is damaged (it is not a tally); run again")
    return run_tally


def _example(scenario: Scenario) -> RunTally:
    """A tally without slots, which has an instance wherever the tally of a run may have one."""
    example = RunTally.from_scenario(scenario, scenario.trials)
    example.begin()
    return example
