"""`evedrop export`: the results of a run for other tools."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from evedrop.cli.command import Command
from evedrop.cli.options import argument, number_type
from evedrop.errors import UsageError

_LONGEST = 3600.0  # seconds per slot, as for pace


def export(options: argparse.Namespace) -> int:
    """Write the results of a run as an MCAP file."""
    from evedrop.results.mcap_export import export_mcap
    from evedrop.results.reading import Results
    from evedrop.results.wire_summary import is_wire
    from evedrop.system.signals import raise_on_signals

    if is_wire(options.run):
        raise UsageError(f"{options.run} is the folder of a wire; give the results folder of a run")
    results = Results.read(options.run)
    with raise_on_signals():
        counts = export_mcap(results, options.file, options.period)
    if results.remark is not None:
        print(results.remark)
    print(f"{sum(counts.values())} messages on {len(counts)} topics are in {options.file}")
    return 0


def _written(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--period",
        type=number_type(math.ulp(0.0), _LONGEST, f"a number of seconds above 0 and up to {_LONGEST:.0f}"),
        metavar="SECONDS",
        help="seconds per slot; default those of the scenario, or 1",
    )


COMMANDS = (
    Command(
        "export",
        export,
        "write a finished run as an MCAP file, for Foxglove",
        (argument("run", "RUN"), _written),
        section="inspect",
        example="export runs/vehicle vehicle.mcap",
        page="results",
    ),
)
