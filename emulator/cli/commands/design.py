"""`evedrop design`: the choice of μ_d."""

from __future__ import annotations

import argparse
import json

from evedrop.cli.options import as_json, changes, changes_of, scenario
from evedrop.command import Command


def design(options: argparse.Namespace) -> int:
    """Print the admissible μ_d, and the cost and secrecy of each choice."""
    from evedrop.api import design as design_of
    from evedrop.cli.report import print_design

    found = design_of(options.scenario, max_trace=options.max_trace, changes=changes_of(options))
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print_design(found)
    return 0


def _designs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-trace", type=float, metavar="Ω", help="find the least μ_d whose limiting trace stays below Ω"
    )


COMMANDS = (
    Command(
        "design", design, "admissible μ_d, secrecy, optimum, per eavesdropper", (scenario, changes, _designs, as_json)
    ),
)
