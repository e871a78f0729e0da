"""`evedrop process fit`: the process that explains recorded states."""

from __future__ import annotations

import argparse

from evedrop.cli.command import Command
from evedrop.cli.options import argument, as_json
from evedrop.errors import UsageError
from evedrop.system.output import print_json


def fit(options: argparse.Namespace) -> int:
    """Fit a process to recorded states."""
    from evedrop.scenario.fitting.process_fit import fit_process

    names = None if options.states is None else [name.strip() for name in options.states.split(",")]
    fitted = fit_process(options.file, names, _numbers(options.reference))
    if options.json:
        print_json(fitted.as_dict())
    else:
        print("\n".join([*(f"# {line}" for line in fitted.remarks), "", fitted.toml]))
    return 0


def _numbers(text: str | None) -> list[float] | None:
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise UsageError(f"--reference {text}: expected numbers such as 55,50") from None


def _fits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--states", metavar="X,Y", help="the columns that are states; default all but time")
    parser.add_argument("--reference", metavar="X,Y", help="the levels from which states are deviations; default 0")


COMMANDS = (
    Command(
        "fit",
        fit,
        "find the process that explains recorded states",
        (argument("file", "FILE"), _fits, as_json),
        group="process",
        section="study",
        example="process fit pose.csv",
        page="programs",
    ),
)
