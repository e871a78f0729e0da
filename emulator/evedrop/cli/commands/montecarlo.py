"""`evedrop montecarlo`: the trials of a scenario in memory."""

from __future__ import annotations

import argparse

from evedrop.cli.command import Command
from evedrop.cli.in_memory import MEMORY, check_resuming, plan_of
from evedrop.cli.options import loaded, over_wire, print_so_far, scenario
from evedrop.cli.tables import tables
from evedrop.errors import Interrupted


def montecarlo(options: argparse.Namespace) -> int:
    """Run the trials of a scenario in memory."""
    from evedrop.cli.progress_line import ProgressLine
    from evedrop.results.folder import results_folder
    from evedrop.simulate.montecarlo import simulate

    check_resuming(options)
    options.trials = 1000 if options.trials is None else options.trials
    plan = plan_of(options)
    scenario = loaded(options, beyond_horizon=options.mode != "exact")
    with results_folder(options.out, options.scenario) as folder:
        with ProgressLine(scenario.trials * scenario.slots, "trial-slots", options.json) as line:
            try:
                status = simulate(scenario, folder, line.on_event, plan, resume=options.resume)
            except Interrupted:
                print_so_far(line.moved or folder, options.json)
                raise
        print_so_far(line.moved or folder, options.json)
    return status


def _rare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rare",
        action="store_true",
        help="also estimate the mean errors that rare events carry: split trials with large errors (docs/montecarlo.md)",
    )


COMMANDS = (
    Command(
        "montecarlo",
        montecarlo,
        "simulate the trials of a scenario in memory (1000 unless told otherwise)",
        (scenario, over_wire, *MEMORY, _rare, tables),
        section="run",
        example="montecarlo vehicle --trials 200",
        page="montecarlo",
    ),
)
