"""Writes docs/maintainers/failures: for each of ten mistakes, a case of the simulated world that shows it.

    python -m tests.virtual.failures                                writes all texts again, after a change
    python -m tests.virtual.failures NAME "the mutant" SEED         writes a new one, of a seed that notices the mutant

A text names its mutant and its case, so it is all that is needed to play it again. The mutant is the one of tests/mutants.toml
whose description it is.
"""

from __future__ import annotations

import difflib
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.mutants import PACKAGE, Mutant, copy_with, mutants

_ROOT = PACKAGE.parents[1]
TEXTS = _ROOT / "docs" / "maintainers" / "failures"
_CASE = re.compile(r"^    (\{.*\})$", re.MULTILINE)


def text_of(mutant: Mutant, case: str) -> str:
    """What is broken, how the case is played again, and what became of it."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy_with(mutant, Path(folder))
        changed = (Path(folder) / "evedrop" / mutant.file).read_text("utf-8")
        said = _simulated(Path(folder), "--case", case)
    before = (PACKAGE / mutant.file).read_text("utf-8")
    lines = difflib.unified_diff(
        before.splitlines(), changed.splitlines(), mutant.file, "with the mistake", "", "", 1, ""
    )
    # Without line numbers, which change with every edit above the mistake.
    change = ("@@" if line.startswith("@@") else line for line in lines)
    return f"{mutant.breaks}\n\n" + "\n".join(change) + f"\n\nThe case:\n\n    {case}\n\n{said}"


def again(text: str) -> str:
    """The same text, played again."""
    words = text.partition("\n")[0]
    (mutant,) = [mutant for mutant in mutants(words) if mutant.breaks == words]
    case = _CASE.search(text)
    if case is None:
        raise ValueError(f"the text of {words!r} has no case")
    return text_of(mutant, case[1])


def _shrunk(mutant: Mutant, seed: str) -> str:
    """The shrunk case of a seed that notices the mutant."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy_with(mutant, Path(folder))
        said = _simulated(Path(folder), "--explain", seed)
    case = re.search(r"--case '(\{.*\})'$", said, re.MULTILINE)
    if case is None:
        raise ValueError(f"seed {seed} does not notice {mutant.breaks!r}:\n{said}")
    return case[1]


def _simulated(folder: Path, *words: str) -> str:
    """What `tests.virtual.simulated` prints, with the copy of the package in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "tests.virtual.simulated", *words],
        cwd=_ROOT,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    ).stdout


def main(arguments: list[str]) -> None:
    """Write the texts."""
    if arguments:
        name, words, seed = arguments
        (mutant,) = mutants(words)
        (TEXTS / f"{name}.txt").write_text(text_of(mutant, _shrunk(mutant, seed)), "utf-8")
        return
    for path in sorted(TEXTS.glob("*.txt")):
        path.write_text(again(path.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
