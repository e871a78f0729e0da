"""The table of `make bench`: its rows, its heading, and how a family of metrics is run alone."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

from evedrop.model.kernels.choice import KERNELS

COLUMNS = ("what", "measured", "yardstick", "at least", "aim", "holds?")
FAILED = "failed"
_ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Row:
    """One metric: what it is, what was measured now, and with what to compare it."""

    what: str
    measured: str
    yardstick: str
    at_least: str
    aim: str
    holds: str

    @property
    def markdown(self) -> str:
        """The row as a line of a Markdown table."""
        return _line(asdict(self).values())


def judged(at_least: bool, aim: bool) -> str:
    """The last column: whether a metric reaches what it must reach, and whether it reaches the aim."""
    return "yes, and the aim" if at_least and aim else "yes" if at_least else "no"


def head() -> str:
    """The head of the Markdown table."""
    return f"{_line(COLUMNS)}\n{'|---' * len(COLUMNS)}|"


def heading(quick: bool) -> str:
    """Where, when and of what the table is measured."""
    sizes = (
        " The sizes are those of `--quick`: they show that everything runs, and are too small to judge by."
        if quick
        else ""
    )
    return (
        f"`make bench`, {date.today().isoformat()}, commit {_commit()}, on {_processor()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}, kernels {KERNELS}, load {load()} before the start. Medians over rounds.{sizes}"
    )


def load() -> str:
    """How many processes wanted to run, on average over the last minute."""
    return f"{os.getloadavg()[0]:.1f}"


def run_alone(rows: Callable[[bool], Iterable[Row]]) -> None:
    """The main program of a family: prints a table, or with `--json` a line of JSON for each row; `--quick`: small sizes."""
    as_json = "--json" in sys.argv
    if not as_json:
        print(head())
    for row in rows("--quick" in sys.argv):
        print(json.dumps(asdict(row)) if as_json else row.markdown, flush=True)


def read_row(line: str) -> Row:
    """The row of a line of JSON."""
    entries: dict[str, Any] = json.loads(line)
    return Row(**entries)


def _line(cells: Iterable[str]) -> str:
    return "".join(f"| {cell.replace('|', '/')} " for cell in cells) + "|"


def _commit() -> str:
    """The commit of this checkout, and whether its files were changed since."""
    try:
        name = subprocess.run(
            ["git", "-C", _ROOT, "describe", "--always", "--dirty=, with changes", "--exclude=*"],  # noqa: S607
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name.stdout.strip()


def _processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
