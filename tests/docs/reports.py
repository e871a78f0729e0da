"""A report of each kind on paper: `python -m tests.docs.reports FOLDER` writes them as PDF, if the machine has Chromium.

`make docs` puts them beside the page of screens. Look at each of them after a change of the report.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from tests.docs.browser import CHROMIUM, printed
from tests.docs.pictures import ROOT, wire_at_work

_STUDY = ("vehicle", "--slots", "400", "--trials", "20", "--out")
KINDS: Mapping[str, tuple[str, ...]] = {
    "run": ("run", "vehicle", "--slots", "1000", "--pace", "0", "--view", "off", "--out"),
    "study": ("montecarlo", *_STUDY),
    "sweep": ("sweep", "--over", "encoding.state_probability=0.3,0.5,0.7", *_STUDY),
    "comparison": ("compare", "acknowledged", "--slots", "90", "--trials", "10", "--out"),
    "tests": ("test", str(ROOT / "scenarios" / "bursts.toml"), "--in-memory", "--trials", "20", "--out"),
}
"""Kind → the command that makes results with such a report, in front of their folder."""


def main(folder: Path) -> None:
    """Print a report of each kind."""
    if CHROMIUM is None:
        sys.stdout.write("there is no Chromium: no report is printed\n")
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as results:
        places = {kind: Path(results) / kind for kind in KINDS}
        for kind, command in KINDS.items():
            subprocess.run(
                [sys.executable, "-m", "evedrop", *command, str(places[kind])], check=True, capture_output=True
            )
        places["wire"] = wire_at_work(Path(results))
        for kind, place in places.items():
            page = next(iter([*place.glob("tests.html"), place / "report.html"]))
            try:
                printed(page, folder / f"report-{kind}.pdf")
            except OSError as error:  # the browser is at fault, not the page
                sys.stdout.write(f"{error}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
