"""`evedrop diff`: where two runs differ."""

from __future__ import annotations

import argparse
from pathlib import Path

from evedrop.cli.command import Command


def diff(options: argparse.Namespace) -> int:
    """Compare two runs."""
    from evedrop.results.diff import difference
    from evedrop.results.reading import Results

    runs = [Results.read(run) for run in options.runs]
    differences = difference(*runs)
    print(differences.text)
    for remark in filter(None, (run.remark for run in runs)):
        print(remark)
    return 0 if differences.same else 1


def _two_runs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs=2, type=Path, metavar="RUN")


COMMANDS = (
    Command(
        "diff",
        diff,
        "show the first difference between two runs",
        (_two_runs,),
        section="inspect",
        example="diff runs/one runs/other",
        page="results",
    ),
)
