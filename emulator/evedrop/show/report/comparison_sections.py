"""The sections of the report of a comparison. To add one, write a class and add it to `COMPARISON_SECTIONS`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final
from xml.etree import ElementTree as ET

from evedrop.model.figures.text import estimate
from evedrop.results.comparison import Cell, Comparison, read_comparison
from evedrop.score.verdict import SecrecyKept
from evedrop.show.report.comparison import comparison_lines, pairs_table, schemes_table, verdict
from evedrop.show.report.markup import Node, element, paragraphs
from evedrop.show.report.section import Section
from evedrop.show.report.tables import captioned, html_table
from evedrop.show.view import palette
from evedrop.show.view.palette import hexadecimal

_GROUND = {
    SecrecyKept.PERFECT: palette.PERFECT,
    SecrecyKept.RELATIVE: palette.RELATIVE,
    SecrecyKept.UNDECIDED: palette.UNDECIDED,
    SecrecyKept.BROKEN: palette.BROKEN,
}
_INK = {SecrecyKept.PERFECT: "#fff"}
_DARK = "#16191d"


@dataclass(frozen=True)
class ComparisonSource:
    """The folder of a comparison, read."""

    folder: Path
    found: Comparison

    @classmethod
    def read(cls, folder: Path) -> ComparisonSource:
        """Read a folder. Raises UsageError if it is not that of a comparison."""
        return cls(folder, read_comparison(folder))

    @property
    def outcome(self) -> str:
        """How many pairs have each verdict, as a sentence."""
        verdicts = [cell.verdict for one in self.found.schemes.values() for cell in one.cells.values()]
        counts = [(word, verdicts.count(word)) for word in SecrecyKept]
        said = ", ".join(f"{count:,} {word.value}" for word, count in counts if count)
        return f"Secrecy of {sum(count for _, count in counts):,} pairs of scheme and adversary: {said}"


@final
class MatrixSection(Section[ComparisonSource]):
    """The verdict on each scheme against each adversary."""

    title = "Verdicts"

    @classmethod
    def nodes(cls, of: ComparisonSource) -> Iterator[Node]:
        """A table of verdicts, each with the ratio of the errors."""
        found = of.found
        caption = "The adversary's error over the legitimate one, and the verdict on secrecy; ·: not defined"
        heads = [element("th", one, scope="col") for one in ("scheme", *found.adversaries)]
        body = element("tbody")
        for name, one in found.schemes.items():
            row = element("tr", element("th", name, scope="row"))
            row.extend(_cell(one.cells[adversary]) for adversary in found.adversaries)
            body.append(row)
        yield captioned(element("tr", *heads), body, caption)


def _cell(cell: Cell) -> ET.Element:
    kept = cell.verdict
    if kept is None:
        return element("td", "·", class_="verdict", title=cell.match.not_defined)
    colours = f"background:{hexadecimal(_GROUND[kept])};color:{_INK.get(kept, _DARK)}"
    ratio = f"{estimate(cell.ratio, None, '.3g')}×"
    return element("td", element("b", verdict(cell)), ratio, class_="verdict", style=colours)


@final
class SchemesSection(Section[ComparisonSource]):
    """What each scheme costs, and its closest adversary."""

    title = "Schemes"

    @classmethod
    def nodes(cls, of: ComparisonSource) -> Iterator[Node]:
        """The table that the terminal shows, and its notes."""
        yield html_table(schemes_table(of.found), "Cost and secrecy of each scheme; errors ± standard errors")
        yield from paragraphs(comparison_lines(of.found))


@final
class PairsSection(Section[ComparisonSource]):
    """The errors of every pair, with theory and z."""

    title = "Pairs"

    @classmethod
    def nodes(cls, of: ComparisonSource) -> Iterator[Node]:
        """The table that the terminal shows."""
        yield html_table(pairs_table(of.found), "Errors ± standard errors, with theory; z: the z-score against theory")


@final
class ComparisonRepeat(Section[ComparisonSource]):
    """How to repeat the simulations."""

    title = "Repeat it"

    @classmethod
    def nodes(cls, of: ComparisonSource) -> Iterator[Node]:
        """A command for each simulated scenario."""
        found = of.found
        yield element(
            "p", f"Seed {found.seed}, trials from {found.first_trial:,} on. Each simulation of the comparison again:"
        )
        commands = [
            f"evedrop montecarlo {shlex.quote(str(path.absolute()))} --trials {found.trials}"
            for path in sorted((of.folder / "scenarios").glob("*.toml"))
        ]
        yield element("pre", element("code", "\n".join(commands)))


COMPARISON_SECTIONS: tuple[type[Section[ComparisonSource]], ...] = (
    MatrixSection,
    SchemesSection,
    PairsSection,
    ComparisonRepeat,
)
"""In the order of the page."""
