"""Writes report.html into a results folder: of a run, a sweep or a comparison.

Source: docs/results.md, report.html.
"""

from __future__ import annotations

from pathlib import Path

from evedrop.errors import UsageError
from evedrop.results.folder import replace_private
from evedrop.results.reading import Results, results_of_this_version
from evedrop.show.report.kinds import page_of
from evedrop.show.report.page import Page
from evedrop.system.output import warn

REPORT = "report.html"
"""The file in a results folder."""


def write_report(folder: Path) -> Path:
    """Make the report of a results folder, and return its path.

    Raises UsageError if it is not a results folder, and OSError if the report cannot be written; an older one is then unchanged.
    """
    with results_of_this_version(folder):
        return write_page(folder, page_of(folder))


def write_page(folder: Path, page: Page) -> Path:
    """Write a page as the report of a folder; it is there completely or not at all. Raises OSError."""
    replace_private(folder / REPORT, page.html)
    return folder / REPORT


def has_results(folder: Path) -> bool:
    """Whether a run left anything in its folder that a report can show."""
    try:
        Results.read(folder)
    except UsageError:
        return False
    return True


def try_report(folder: Path) -> Path | None:
    """The same for a run that has just ended: a report that cannot be made gives a warning, and None."""
    try:
        return write_report(folder)
    except Exception as error:  # the results are complete without a page
        why = f"{type(error).__name__}: {error}" if not isinstance(error, OSError) else str(error)
        warn(f"{REPORT} was not written ({' '.join(why.split())}); to write it later: evedrop report {folder}")
        return None
