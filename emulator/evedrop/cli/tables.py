"""The tables that a command prints, as files: `--csv` and `--latex`.

Every table that is printed on `evedrop.cli.report.terminal` is taken, so that a command with these options need do nothing.

Source: docs/export.md, tables.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.errors import UsageError
from evedrop.system.files import check_writable
from evedrop.system.output import warn

if TYPE_CHECKING:
    from evedrop.show.report.text_table import TextTable

TAKEN: ContextVar[list[TextTable] | None] = ContextVar("TAKEN", default=None)
"""The tables that the current command has printed, if they are to be written to files."""


@contextlib.contextmanager
def written_tables(options: argparse.Namespace) -> Iterator[None]:
    """Write the tables that are printed in the block to the files of `--csv` and `--latex`, if they are given.

    Tables that were printed before an error are written, too.

    Raises UsageError together with `--json`, and for a file that cannot be written: before the block, if it shows by then.
    """
    files = getattr(options, "csv", None), getattr(options, "latex", None)
    if files == (None, None):
        yield
        return
    if getattr(options, "json", False):
        raise UsageError("--csv and --latex write the table that --json replaces; leave --json or these out")
    if len({file and os.path.realpath(file) for file in files}) == 1:
        raise UsageError(f"--csv and --latex are both {files[0]}; give two files")
    made = Path("runs") if getattr(options, "out", None) is None else options.out
    for file in files:
        if file is not None and (file.parent.exists() or not file.absolute().is_relative_to(made.absolute())):
            try:
                check_writable(file)
            except OSError as error:
                raise UsageError(f"{file} cannot be written ({error.strerror}); give another file") from error
    taken: list[TextTable] = []
    token = TAKEN.set(taken)
    try:
        yield
    except BaseException:
        for problem in _write(taken, *files):
            warn(problem)
        raise
    finally:
        TAKEN.reset(token)
    if problems := _write(taken, *files):
        raise UsageError("\n  ".join(problems))


def _write(taken: Sequence[TextTable], as_csv: Path | None, latex: Path | None) -> list[str]:
    """Write the files that are given; returns why some could not be written."""
    from evedrop.show.report.text_table import write_csv, write_latex

    problems = []
    for write, file in ((write_csv, as_csv), (write_latex, latex)):
        if file is not None and taken:
            try:
                write(taken, file)
            except UsageError as error:
                problems.append(str(error))
    return problems
