"""`evedrop sweep`: Monte Carlo over a grid of values of some entries."""

from __future__ import annotations

import argparse
from pathlib import Path

from evedrop.cli.command import Command
from evedrop.cli.in_memory import MEMORY, check_resuming, plan_of
from evedrop.cli.options import changes_of, scenario
from evedrop.cli.tables import tables
from evedrop.system.output import print_json


def sweep(options: argparse.Namespace) -> int:
    """Run Monte Carlo over a grid."""
    from evedrop.cli.closing_report import report_page
    from evedrop.cli.progress_line import ProgressLine
    from evedrop.cli.report import print_sweep
    from evedrop.results.folder import results_folder
    from evedrop.studies.sweep import grid_of, sweep_over

    check_resuming(options)
    options.trials = 1000 if options.trials is None else options.trials
    grid = grid_of(options.over)
    plan = plan_of(options)
    with (
        results_folder(options.out, f"{Path(options.scenario).stem}-sweep") as folder,
        ProgressLine(None, "trial-slots", options.json) as line,
    ):
        table = sweep_over(
            options.scenario, changes_of(options), grid, folder, line.on_event, plan, resume=options.resume
        )
    if options.json:
        print_json(table.to_pylist())
    else:
        print_sweep(table, tuple(grid), str(folder))
    report_page(folder, options.json)
    return 0


def _over(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--over",
        action="append",
        required=True,
        metavar="KEY=VALUES",
        help="an entry and its values, first:last:step or a,b,c; repeatable",
    )


COMMANDS = (
    Command(
        "sweep",
        sweep,
        "simulate a scenario in memory over a grid of values",
        (scenario, _over, *MEMORY, tables),
        section="study",
        example="sweep numerical --over encoding.state_probability=0.6,0.7,0.8",
        page="montecarlo",
    ),
)
