"""Whether the campaign of faults notices mistakes: each mutant is put into a copy of the package, and cases are run against that.

    python -m tests.faults.mutation

Prints a row for each mutant: what noticed it, and after how many cases. A mutant that the campaign does not notice is a gap of
its judge. Source: docs/maintainers/tests.md, faults.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.faults import ours

_ROOT = Path(__file__).parents[2]
_MUTANTS = Path(__file__).with_name("mutants.toml")
_PACKAGE = _ROOT / "emulator" / "evedrop"
_LIMIT_SECONDS = 900.0
_SHOWN = 200


@dataclass(frozen=True)
class Mutant:
    """A mistake: the text `old` of a file becomes `new`."""

    breaks: str
    """What it breaks, in words."""
    file: str
    """Below `emulator/evedrop/`."""
    seeds: list[int]
    """The campaign's cases that are run against it."""
    old: str
    new: str


def mutants() -> list[Mutant]:
    """All mutants."""
    return [Mutant(**entry) for entry in tomllib.loads(_MUTANTS.read_text(encoding="utf-8"))["mutant"]]


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
        by = "NOT NOTICED" if self.noticed is None else self.noticed.replace("|", "\\|")
        return f"| {self.mutant.breaks} | `{self.mutant.file}` | {by} | {self.cases} | {self.seconds:.0f} s |"


def mutated(mutant: Mutant, text: str) -> str:
    """The text of the mutant's file with its mistake. Raises ValueError unless the file has the old text exactly once."""
    count = text.count(mutant.old)
    if count != 1:
        raise ValueError(f"{mutant.file} has the text of the mutant {mutant.breaks!r} {count} times, not once")
    return text.replace(mutant.old, mutant.new)


def tried(mutant: Mutant, folder: Path) -> Outcome:
    """Run the cases of a mutant until one notices it. folder: for the copy of the package."""
    source = folder / "evedrop"
    shutil.copytree(_PACKAGE, source, ignore=shutil.ignore_patterns("__pycache__"))
    path = source / mutant.file
    path.write_text(mutated(mutant, path.read_text(encoding="utf-8")), encoding="utf-8")
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
    text = " ".join(line.replace(str(folder / "kept"), "").split())
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} …"


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all mutants, or those whose description contains a word; 1 if one is not noticed."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.mutation", description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="mutants whose description or file contains this")
    options = parser.parse_args(arguments)
    chosen = [mutant for mutant in mutants() if options.only in f"{mutant.breaks} {mutant.file}"]
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
