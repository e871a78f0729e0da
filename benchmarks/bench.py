"""Every performance metric of Evedrop, in one run, as a Markdown table.

    make bench                     # python benchmarks/bench.py; about twenty minutes
    make bench QUICK=--quick       # small sizes, about a minute: shows only that everything runs

The rows come from one program for each family of metrics, which can also be run alone. A program that fails or does not end is
reported as failed, and the others are run all the same; the exit status is then 1. Otherwise it is 0, whether or not the metrics
reach what they must.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from table import FAILED, Row, head, heading, load, read_row

_HERE = Path(__file__).parent
_SAID_LINES = 15


@dataclass(frozen=True)
class Family:
    """A family of metrics: the program that measures them, and how long it may take."""

    program: Path
    seconds: float
    """With full sizes; a tenth of it, but at least two minutes, with small ones."""


FAMILIES = tuple(
    Family(_HERE / f"{name}.py", seconds)
    for name, seconds in (
        ("throughput", 1800.0),
        ("latency", 600.0),
        ("kernels", 900.0),
        ("montecarlo", 900.0),
        ("start_up", 600.0),
        ("memory", 1200.0),
        ("recording", 300.0),
        ("wire", 1200.0),
    )
)


class Failure(Exception):
    """A program failed, or did not end in time."""


def rows_of(family: Family, quick: bool) -> Iterator[Row]:
    """The rows of a family as they come. Raises Failure, after the rows that it could measure."""
    command = [sys.executable, str(family.program), "--json", *(["--quick"] if quick else [])]
    # A session of its own, so that all that it has started can be ended with it.
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    limit = max(120.0, family.seconds / 10) if quick else family.seconds
    try:
        out, errors = process.communicate(timeout=limit)
        late = ""
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, errors = process.communicate()
        late = f"did not end within {limit:.0f} s"
    for line in out.splitlines():
        yield read_row(line)
    if late or process.returncode:
        last = "\n".join(errors.splitlines()[-_SAID_LINES:])
        raise Failure(f"{family.program.name} {late or f'ended with status {process.returncode}'}\n{last}".strip())


def main(quick: bool, families: Sequence[Family] = FAMILIES) -> int:
    """Print the table; returns the exit status."""
    print(f"{heading(quick)}\n\n{head()}", flush=True)
    failures = []
    for family in families:
        try:
            for row in rows_of(family, quick):
                print(row.markdown, flush=True)
        except Failure as error:
            failures.append(str(error))
            print(Row(f"`{family.program.name}`", FAILED, "", "", "", FAILED).markdown, flush=True)
    print(f"\nLoad {load()} at the end.")
    for failure in failures:
        print(f"\n{failure}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="All benchmarks, one after the other.")
    parser.add_argument("--quick", action="store_true", help="small, to see that each of them runs")
    sys.exit(main(parser.parse_args().quick))
