"""The tables that a command prints, as files: `--csv` and `--latex`.

Every table that is printed on `evedrop.cli.report.terminal` is taken, so that a command with these options need do nothing.

Source: docs/export.md, tables.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.errors import UsageError

if TYPE_CHECKING:
    from evedrop.show.report.text_table import TextTable

TAKEN: ContextVar[list[TextTable] | None] = ContextVar("TAKEN", default=None)
"""The tables that the current command has printed, if they are to be written to files."""


def tables(parser: argparse.ArgumentParser) -> None:
    """Add `--csv` and `--latex`, for the tables that the command prints."""
    parser.add_argument("--csv", type=Path, metavar="FILE", help="also write the table as CSV, at full precision")
    parser.add_argument("--latex", type=Path, metavar="FILE", help="also write the table as a tabular of LaTeX")


@contextlib.contextmanager
def written_tables(options: argparse.Namespace) -> Iterator[None]:
    """Write the tables that are printed in the block to the files of `--csv` and `--latex`, if they are given.

    Tables that were printed before an error are written, too.

    Raises UsageError together with `--json`, and for a file that cannot be written.
    """
    files = getattr(options, "csv", None), getattr(options, "latex", None)
    if files == (None, None):
        yield
        return
    if getattr(options, "json", False):
        raise UsageError("--csv and --latex write the table that --json replaces; leave --json or these out")
    taken: list[TextTable] = []
    token = TAKEN.set(taken)
    try:
        yield
    finally:
        TAKEN.reset(token)
        _write(taken, *files)


def _write(taken: Sequence[TextTable], as_csv: Path | None, latex: Path | None) -> None:
    from evedrop.show.report.text_table import write_csv, write_latex

    if as_csv is not None:
        write_csv(taken, as_csv)
    if latex is not None and taken:
        write_latex(taken, latex)
