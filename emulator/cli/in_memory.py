"""Shared by commands that simulate in memory: their options, and studies of one scenario."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from evedrop.cli.options import entries, loaded, output, workers

if TYPE_CHECKING:
    from evedrop.memory.montecarlo import Plan
    from evedrop.scenario import Scenario

T = TypeVar("T")


def memory(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how trials are computed."""
    workers(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="use a Dask cluster, tcp://HOST:PORT")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument(
        "--covariance-only",
        dest="mode",
        action="store_const",
        const="covariance-only",
        help="simulate covariances given the events; draws no noise",
    )
    mode.add_argument(
        "--error-coordinates",
        dest="mode",
        action="store_const",
        const="error-coordinates",
        help="simulate the errors themselves: any number of slots, no digest",
    )
    parser.set_defaults(mode="exact")


def studied(options: argparse.Namespace, study: Callable[[Scenario, Callable[[int], None]], T]) -> tuple[Scenario, T]:
    """Run a study of a command's scenario, with 100 trials by default, and show its progress.

    Returns the scenario and what the study found.
    """
    from evedrop.cli.progress_line import ProgressLine
    from evedrop.memory.montecarlo import teller

    options.trials = 100 if options.trials is None else options.trials
    scenario = loaded(options)
    total = scenario.trials * scenario.slots
    with ProgressLine(total, "trial-slots", options.json) as line:
        return scenario, study(scenario, teller(line.tell, total))


MEMORY = (entries, output, memory)


def plan_of(options: argparse.Namespace) -> Plan:
    """The plan, how trials are computed, from the options of `memory`."""
    from evedrop.memory.montecarlo import Plan
    from evedrop.memory.simulation import Mode

    return Plan(Mode(options.mode), options.workers, options.scheduler, rare=getattr(options, "rare", False))
