"""Mistakes that are put into a copy of the package, so that a campaign shows whether it notices them."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "emulator" / "evedrop"
_MUTANTS = Path(__file__).with_name("mutants.toml")
_SHOWN = 200


@dataclass(frozen=True)
class Mutant:
    """A mistake: the text `old` of a file becomes `new`."""

    breaks: str
    """What it breaks, in words."""
    file: str
    """Below `emulator/evedrop/`."""
    old: str
    new: str
    seeds: Sequence[int] = ()
    """The cases of the campaign on real processes that are run against it; none if only the simulated world notices it."""
    simulated: bool = True
    """Whether the simulated world must notice it."""

    @property
    def row(self) -> str:
        """The beginning of its row in a table."""
        return f"| {self.breaks} | `{self.file}` |"


def mutants(only: str = "") -> list[Mutant]:
    """All mutants whose description or file contains a text."""
    entries = tomllib.loads(_MUTANTS.read_text(encoding="utf-8"))["mutant"]
    return [mutant for mutant in (Mutant(**entry) for entry in entries) if only in f"{mutant.breaks} {mutant.file}"]


def mutated(mutant: Mutant, text: str) -> str:
    """The text of the mutant's file with its mistake.

    Raises ValueError unless the file has the old text exactly once, and SyntaxError if the new one is no Python.
    """
    count = text.count(mutant.old)
    if count != 1:
        raise ValueError(f"{mutant.file} has the text of the mutant {mutant.breaks!r} {count} times, not once")
    text = text.replace(mutant.old, mutant.new)
    compile(text, mutant.file, "exec")
    return text


def copy_with(mutant: Mutant, folder: Path) -> None:
    """Put a copy of the package with the mistake into a folder, which is then put on PYTHONPATH.

    What Python has compiled is copied too, except of the file with the mistake: to compile it all takes seconds.
    """
    source = folder / "evedrop"
    shutil.copytree(PACKAGE, source, ignore=shutil.ignore_patterns(f"{Path(mutant.file).stem}.*.pyc"))
    path = source / mutant.file
    path.write_text(mutated(mutant, path.read_text(encoding="utf-8")), encoding="utf-8")


def cell(line: str) -> str:
    """What noticed a mutant, as a cell of a table."""
    text = " ".join(line.split())
    return (text if len(text) <= _SHOWN else f"{text[:_SHOWN]} …").replace("|", "\\|")
