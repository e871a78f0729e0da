"""`evedrop figures`: the paper's figures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from evedrop.cli.command import Command
from evedrop.errors import UsageError


def figures(options: argparse.Namespace) -> int:
    """Draw the paper's figures."""
    from evedrop.studies.papers.kennedy2022 import Size
    from evedrop.studies.papers.kennedy2022 import figures as draw

    try:
        report = draw(
            options.folder,
            lambda text: print(text, file=sys.stderr),
            Size(microgrid_trials=1000) if options.full else Size(),
        )
    except OSError as error:
        raise UsageError(f"{options.folder} cannot be written ({error.strerror}); give another folder") from error
    print(report)
    return 0


def _figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", type=Path, default=Path("figures"), metavar="DIR")
    parser.add_argument(
        "--full", action="store_true", help="simulate the paper's 1000 trials of a day; takes minutes, not seconds"
    )


COMMANDS = (
    Command(
        "figures",
        figures,
        "draw the figures of the paper, and a table of its numbers and ours",
        (_figures,),
        section="study",
        example="figures paper/",
        page="papers",
    ),
)
