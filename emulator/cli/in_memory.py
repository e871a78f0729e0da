"""The options of commands that simulate in memory."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from evedrop.cli.options import entries, output, workers

if TYPE_CHECKING:
    from evedrop.memory.montecarlo import Plan


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


MEMORY = (entries, output, memory)


def plan_of(options: argparse.Namespace) -> Plan:
    """The plan, how trials are computed, from the options of `memory`."""
    from evedrop.memory.montecarlo import Plan
    from evedrop.memory.simulation import Mode

    return Plan(Mode(options.mode), options.workers, options.scheduler, rare=getattr(options, "rare", False))
