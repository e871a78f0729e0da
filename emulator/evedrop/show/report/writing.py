"""Writes report.html into a results folder: of a run, a sweep or a comparison, or of a wire, whose journal a caller reads.

To add a kind of results that has a report, write a function that makes its page and add it to `KINDS`.

Source: docs/export.md, report.html.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.errors import UsageError
from evedrop.results.comparison import COMPARISON
from evedrop.results.folder import replace_private
from evedrop.results.reading import Results, results_of_this_version
from evedrop.show.report.closing import SWEEP_FILE, amount, outcome
from evedrop.show.report.comparison import comparison_heading
from evedrop.show.report.page import Page, parts_of
from evedrop.show.report.run_sections import RUN_SECTIONS, RunSource
from evedrop.system.output import warn

if TYPE_CHECKING:
    from evedrop.show.report.wire_sections import WireSource


def run_page(folder: Path) -> Page:
    """The report of a run."""
    source = RunSource.read(folder)
    sentence, good = outcome(source.summary)
    return Page(source.summary.scenario, amount(source.summary), sentence, good, parts_of(RUN_SECTIONS, source))


def sweep_page(folder: Path) -> Page:
    """The report of a sweep."""
    from evedrop.show.report.sweep_sections import SWEEP_SECTIONS, SweepSource  # noqa: PLC0415 - no other page needs it

    source = SweepSource.read(folder)
    return Page(f"Sweep of {source.scenario}", source.amount, source.outcome, None, parts_of(SWEEP_SECTIONS, source))


def comparison_page(folder: Path) -> Page:
    """The report of a comparison."""
    from evedrop.show.report.comparison_sections import COMPARISON_SECTIONS, ComparisonSource  # noqa: PLC0415 - the same

    source = ComparisonSource.read(folder)
    about = comparison_heading(source.comparison)
    return Page("Schemes against adversaries", about, source.outcome, None, parts_of(COMPARISON_SECTIONS, source))


def wire_page(source: WireSource) -> Page:
    """The report of a wire."""
    from evedrop.show.report.wire_sections import WIRE_SECTIONS  # noqa: PLC0415 - its import takes 9 MB more

    return Page(source.title, source.about, *source.outcome, parts_of(WIRE_SECTIONS, source))


KINDS: Mapping[str, Callable[[Path], Page]] = {
    SWEEP_FILE: sweep_page,
    COMPARISON: comparison_page,
}
"""A file that only such a folder has → the function that makes its page. Any other folder is that of a run."""


def page_of(folder: Path) -> Page:
    """The report of a results folder. Raises UsageError if it is not one."""
    return next((made for name, made in KINDS.items() if (folder / name).exists()), run_page)(folder)


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


def try_report(folder: Path, write: Callable[[Path], Path] = write_report) -> Path | None:
    """The same for a run that has just ended: a report that cannot be made gives a warning, and None.

    write: what makes and writes it.
    """
    try:
        return write(folder)
    except Exception as error:  # the results are complete without a page
        why = f"{type(error).__name__}: {error}" if not isinstance(error, OSError) else str(error)
        warn(f"{REPORT} was not written ({' '.join(why.split())}); to write it later: evedrop report {folder}")
        return None
