"""The page of `evedrop test` as a whole: a line for each scenario, which links to its report.

Source: docs/testing.md.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from evedrop.counting import counted
from evedrop.results.folder import replace_private
from evedrop.show.report.page import Page, Part, facts_table, made
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.travel import circumstances
from evedrop.studies.scenario_tests import Finding, Outcome
from evedrop.system.output import warn

TESTS_PAGE = "tests.html"
"""The file in the folder of all results folders."""


def write_tests_page(folder: Path, tested: Sequence[Finding], started: float) -> Path | None:
    """Write the page into the folder of the results, and return its path; started: seconds since 1970.

    None if there is no such folder, because no test has results; if the page cannot be written, after a warning.
    """
    if not folder.is_dir() or not any(finding.folder for finding in tested):
        return None
    path = folder / TESTS_PAGE
    try:
        replace_private(path, _page(folder, tested, started).html)
    except OSError as error:
        warn(f"{TESTS_PAGE} was not written ({error})")
        return None
    return path


def _page(folder: Path, tested: Sequence[Finding], started: float) -> Page:
    counts = [(outcome, sum(finding.outcome is outcome for finding in tested)) for outcome in Outcome]
    words = ", ".join(f"{count} {outcome.word}" for outcome, count in counts if count)
    table = TextTable.headed(["scenario", "outcome"], ["time"], ["verdict", "reasons"], wrapped={"verdict", "reasons"})
    for finding in tested:
        mark = "✓" if finding.outcome is Outcome.PASSED else "✗"
        name = finding.scenario
        if finding.report is not None:
            name = made("link", quote(os.path.relpath(finding.report, folder)), finding.scenario)
        table.add(
            name,
            f"{mark} {finding.outcome.word}",
            f"{finding.seconds:.1f} s",
            finding.verdict or "–",
            "; ".join(map(_travelling, finding.reasons)) or "–",
        )
    about = f"{counted(len(tested), 'scenario')} · {sum(finding.seconds for finding in tested):,.1f} s"
    facts = {**circumstances(folder), "date": f"{datetime.fromtimestamp(started, UTC):%Y-%m-%d %H:%M} UTC"}
    parts = [
        Part("Scenarios", [made("table", table, "Each scenario with the link to its report")]),
        Part("Made with", [facts_table(facts, "Date and machine")]),
    ]
    good = all(finding.outcome is Outcome.PASSED for finding in tested)
    return Page("Scenarios as tests", about, words, good, parts)


def _travelling(reason: str) -> str:
    """A reason without the command that names a folder of this machine; the scenario's own page has one for everybody."""
    return reason.partition("; see it again: ")[0]
