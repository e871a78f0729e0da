"""`evedrop report`: makes the page of a results folder again."""

from __future__ import annotations

import argparse

from evedrop.cli.command import Command
from evedrop.cli.options import argument
from evedrop.errors import UsageError


def report(options: argparse.Namespace) -> int:
    """Write the page of a results folder."""
    from evedrop.results.wire_summary import is_wire
    from evedrop.show.report.writing import write_report

    write = write_report
    if is_wire(options.run):  # its summary may have to be made from its journal
        from evedrop.wire.page import write_wire_report as write
    try:
        print(write(options.run))
    except OSError as error:
        raise UsageError(
            f"{options.run}: report.html cannot be written ({error.strerror}); make the folder writable"
        ) from error
    return 0


COMMANDS = (
    Command(
        "report",
        report,
        "write report.html: a run, sweep, comparison or wire on one page",
        (argument("run", "FOLDER"),),
        section="inspect",
        example="report runs/vehicle",
        page="results",
    ),
)
