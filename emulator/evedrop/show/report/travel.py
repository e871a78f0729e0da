"""What a page carries so that its reader can repeat the results: files to save; when and where they were made."""

from __future__ import annotations

import base64
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from markupsafe import Markup

from evedrop.results.folder import STATES
from evedrop.results.resolved_scenario import DISTURBANCES
from evedrop.show.report.page import made
from evedrop.system.files import Unreadable, text_of

SCENARIO = "scenario.toml"
OF_PAGE = "machine, operating system and commit that made this page"
"""What of `circumstances` need not be that of the results."""
_MOST_BYTES = 2**20
_GIT_SECONDS = 5.0


def download(name: str, text: str) -> Markup:
    """A link in the page that saves a text as a file of this name; the page contains the text."""
    return made("download", name, f"data:text/plain;base64,{base64.b64encode(text.encode()).decode()}")


def input_files(folder: Path) -> Iterator[Markup]:
    """What the scenario of a results folder needs beside it, to save; a sentence for a file that is too large to travel."""
    for name in (DISTURBANCES, STATES):
        if (folder / name).exists():
            try:
                yield download(name, text_of(folder / name, _MOST_BYTES))
            except (OSError, Unreadable):
                yield made("paragraph", f"The scenario also needs {name}, which is too large for this page.")


def circumstances(results: Path) -> Mapping[str, str]:
    """When the results were written, and on which system and from which commit this page was made.

    results: the file that was written when they were complete.
    """
    try:
        written = datetime.fromtimestamp(results.stat().st_mtime, UTC)
        date = {"date": f"{written:%Y-%m-%d %H:%M} UTC"}
    except OSError:
        date = {}
    return {
        **date,
        "machine": f"{platform.machine()}, {os.cpu_count()} processors",
        "operating system": platform.platform(terse=True),
        **({"commit": commit} if (commit := _commit()) else {}),
    }


@cache
def _commit() -> str:
    """The commit of the repository that this program runs in; empty where it is installed from a package, or git is missing."""
    root = Path(__file__).resolve().parents[4]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_SECONDS, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
