"""The page of a wire, `report.html`: also of a wire that runs or was killed.

Source: docs/results.md, report.html.
"""

from __future__ import annotations

from pathlib import Path

from evedrop.results.reading import results_of_this_version
from evedrop.show.report.kinds import wire_page
from evedrop.show.report.wire_sections import WireSource
from evedrop.show.report.writing import write_page
from evedrop.wire.on_disk import summary_of_wire


def write_wire_report(folder: Path) -> Path:
    """Write the page into a wire's folder, from its summary or else from its journal; returns its path.

    Raises UsageError if neither can be read, and OSError if the page cannot be written.
    """
    with results_of_this_version(folder):
        return write_page(folder, wire_page(WireSource.of(folder, summary_of_wire(folder))))
