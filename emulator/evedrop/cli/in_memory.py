"""Shared by commands that simulate in memory: their options, and studies of one scenario."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from evedrop.cli.command import flag, one_of, option, together
from evedrop.cli.options import changes_of, entries, loaded, output
from evedrop.errors import UsageError

if TYPE_CHECKING:
    from evedrop.scenario.tables import Scenario
    from evedrop.simulate.montecarlo import Plan
    from evedrop.studies.parts import StudyPlace

T = TypeVar("T")


scheduler = option(
    "--scheduler",
    "ADDRESS",
    "let the workers of this Dask scheduler compute the trials, tcp://HOST:PORT (docs/montecarlo.md)",
)
resuming = flag(
    "--resume",
    "go on with the interrupted study in the folder of --out; all but --workers and --scheduler must be as it was",
)
crew = together(
    option("--workers", "N", "number of worker processes; does not affect the results", type=int), scheduler
)
"""Where trials are computed."""


def check_resuming(options: argparse.Namespace) -> None:
    """Raise UsageError for `--resume` without a folder."""
    if options.resume and options.out is None:
        raise UsageError("--resume goes on with the study in a folder: give the folder with --out DIR")


def default_trials(options: argparse.Namespace, trials: int) -> None:
    """Set the number of trials, unless an option gives one: `--trials`, or `--set trials=N`."""
    if "trials" not in changes_of(options):
        options.trials = trials


keeping = together(
    option(
        "--out",
        "DIR",
        "write the result there, new or empty, and keep finished trials for --resume until it is complete",
        type=Path,
    ),
    resuming,
)
"""For a study that needs no results folder: one that keeps finished trials, and `--resume`."""


memory = together(
    crew,
    one_of(
        option(
            "--covariance-only",
            help_text="simulate covariances given the events; draws no noise",
            dest="mode",
            action="store_const",
            const="covariance-only",
        ),
        option(
            "--error-coordinates",
            help_text="simulate the errors themselves: any number of slots, no digest",
            dest="mode",
            action="store_const",
            const="error-coordinates",
        ),
    ),
    lambda parser: parser.set_defaults(mode="exact"),
)
"""How trials are computed."""


def studied(
    options: argparse.Namespace, study: Callable[[Scenario, Callable[[int], None], Plan, StudyPlace | None], T]
) -> tuple[Scenario, T]:
    """Run a study of a command's scenario, with 100 trials by default, and show its progress.

    Returns the scenario and what the study found.
    """
    from evedrop.cli.console import ProgressLine
    from evedrop.simulate.montecarlo import progress_counter
    from evedrop.studies.parts import StudyPlace

    check_resuming(options)
    default_trials(options, 100)
    plan = plan_of(options)
    scenario = loaded(options)
    total = scenario.trials * scenario.slots
    with ProgressLine(total, "trial-slots", options.json) as line:
        place = None if options.out is None else StudyPlace(options.out, options.resume)
        return scenario, study(scenario, progress_counter(line.on_event, total), plan, place)


MEMORY = (entries, output, memory, resuming)


def plan_of(options: argparse.Namespace) -> Plan:
    """The plan, how and where trials are computed, from the options of `memory` or `crew`. Raises UsageError."""
    from evedrop.simulate.montecarlo import Plan
    from evedrop.simulate.simulation import Mode

    if options.workers is not None and options.workers < 1:
        raise UsageError(f"--workers {options.workers}: expected 1 or more")
    mode = Mode(getattr(options, "mode", Mode.EXACT))
    return Plan(mode, options.workers, options.scheduler, rare=getattr(options, "rare", False))
