"""`evedrop links fit`: the loss model and delays of a recorded link."""

from __future__ import annotations

import argparse
import json

from evedrop.cli.options import argument, as_json
from evedrop.command import Command


def fit_link(options: argparse.Namespace) -> int:
    """Fit loss and delay models to a recorded link."""
    from evedrop.fitting.fit import fit, lines

    found = fit(options.trace, options.column, options.delay_column)
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print("\n".join(lines(found)))
    return 0


def _fits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--column", metavar="C", help="the column of outcomes, if the file has several columns")
    parser.add_argument(
        "--delay-column",
        metavar="C",
        help="the column of delays in slots; default the column named delay, if there is one",
    )


COMMANDS = (
    Command(
        "fit",
        fit_link,
        "the loss model and delays of a recorded link",
        (argument("trace", "TRACE"), _fits, as_json),
        group="links",
    ),
)
