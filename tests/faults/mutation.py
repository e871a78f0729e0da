"""Whether the campaign of faults notices mistakes: each mutant is put into a copy of the package, and cases are run against that.

    python -m tests.faults.mutation

Prints a row for each mutant: what noticed it, and after how many cases. A mutant that the campaign does not notice is a gap of
its judge. Source: docs/maintainers/tests.md, faults.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.faults import ours
from tests.mutants import Mutant, cell, copy_with, mutants

_ROOT = Path(__file__).parents[2]
_LIMIT_SECONDS = 900.0


@dataclass(frozen=True)
class Outcome:
    """What the campaign said of a mutant."""

    mutant: Mutant
    noticed: str | None
    """The first line that says so; None if nothing does."""
    output: str
    """All that the campaign said."""
    cases: int
    """How many cases had been carried out by then; 0 if an undisturbed run was already wrong."""
    seconds: float

    def __str__(self) -> str:
        return f"{self.mutant.row} {self.noticed or 'NOT NOTICED'} | {self.cases} | {self.seconds:.0f} s |"


def tried(mutant: Mutant, folder: Path) -> Outcome:
    """Run the cases of a mutant until one notices it. folder: for the copy of the package."""
    copy_with(mutant, folder)
    begun = time.monotonic()
    seeds = [str(seed) for seed in mutant.seeds]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [
        sys.executable,
        "-m",
        "tests.faults.campaign",
        "--first",
        "--keep",
        str(folder / "kept"),
        "--seed",
        *seeds,
    ]
    try:
        done = subprocess.run(
            command, cwd=_ROOT, env=environment, capture_output=True, text=True, check=False, timeout=_LIMIT_SECONDS
        )
        output = done.stdout if done.returncode in (0, 1) else f"REFUSED {done.stderr.strip().splitlines()[-1]}"
    except subprocess.TimeoutExpired:
        output = f"REFUSED the campaign did not end within {_LIMIT_SECONDS:.0f} s"
        for temporary in (folder / "kept").glob("**/temporary"):
            ours.end_all(list(ours.marked(temporary)))
    return outcome_of(mutant, output, time.monotonic() - begun, folder)


def outcome_of(mutant: Mutant, output: str, seconds: float, folder: Path) -> Outcome:
    """Whether the campaign noticed a mutant, read from its output."""
    cases = 0
    for line in output.splitlines():
        if line.startswith("REFUSED "):
            return Outcome(mutant, f"undisturbed: {_short(line.removeprefix('REFUSED '), folder)}", output, 0, seconds)
        if re.match(r" *\d+  ", line):
            cases += 1
        elif line.startswith("        "):
            return Outcome(mutant, _short(line, folder), output, cases, seconds)
    return Outcome(mutant, None, output, cases, seconds)


def _short(line: str, folder: Path) -> str:
    return cell(line.replace(str(folder / "kept"), ""))


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all mutants, or those whose description contains a word; 1 if one is not noticed."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.mutation", description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="mutants whose description or file contains this")
    options = parser.parse_args(arguments)
    chosen = [mutant for mutant in mutants(options.only) if mutant.seeds]
    _say(f"| {len(chosen)} mutants | file | noticed by | cases | time |\n|---|---|---|---|---|")
    outcomes = []
    for mutant in chosen:
        with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
            outcomes.append(tried(mutant, Path(folder)))
        _say(str(outcomes[-1]))
        if outcomes[-1].noticed is None:
            _say(outcomes[-1].output)
    missed = [outcome for outcome in outcomes if outcome.noticed is None]
    _say(f"\n{len(outcomes) - len(missed)} of {len(outcomes)} mutants were noticed")
    return 1 if missed else 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main())
