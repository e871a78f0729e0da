"""The kinds of results that have a report. To add one, write a function that makes its page and add it to `KINDS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from evedrop.results.comparison import COMPARISON
from evedrop.results.wire_summary import WIRE_FILE
from evedrop.show.report.closing import amount, outcome
from evedrop.show.report.comparison import comparison_heading
from evedrop.show.report.comparison_sections import COMPARISON_SECTIONS, ComparisonSource
from evedrop.show.report.page import Page, parts_of
from evedrop.show.report.run_sections import RUN_SECTIONS
from evedrop.show.report.run_source import RunSource
from evedrop.show.report.sweep_sections import SWEEP_SECTIONS, SWEEP_TABLE, SweepSource
from evedrop.show.report.wire_sections import WIRE_SECTIONS, WireSource


def run_page(folder: Path) -> Page:
    """The report of a run."""
    source = RunSource.read(folder)
    sentence, good = outcome(source.summary)
    return Page(source.summary.scenario, amount(source.summary), sentence, good, parts_of(RUN_SECTIONS, source))


def sweep_page(folder: Path) -> Page:
    """The report of a sweep."""
    source = SweepSource.read(folder)
    return Page(f"Sweep of {source.scenario}", source.amount, source.outcome, None, parts_of(SWEEP_SECTIONS, source))


def comparison_page(folder: Path) -> Page:
    """The report of a comparison."""
    source = ComparisonSource.read(folder)
    about = comparison_heading(source.found)
    return Page("Schemes against adversaries", about, source.outcome, None, parts_of(COMPARISON_SECTIONS, source))


def wire_page(source: WireSource) -> Page:
    """The report of a wire."""
    return Page(source.title, source.about, *source.outcome, parts_of(WIRE_SECTIONS, source))


KINDS: Mapping[str, Callable[[Path], Page]] = {
    SWEEP_TABLE: sweep_page,
    COMPARISON: comparison_page,
    WIRE_FILE: lambda folder: wire_page(WireSource.read(folder)),
}
"""A file that only such a folder has → the function that makes its page. Any other folder is that of a run."""


def page_of(folder: Path) -> Page:
    """The report of a results folder. Raises UsageError if it is not one."""
    return next((made for name, made in KINDS.items() if (folder / name).exists()), run_page)(folder)
