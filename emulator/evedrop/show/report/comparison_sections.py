"""The sections of the report of a comparison. To add one, write a function and add it to `COMPARISON_SECTIONS`."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from evedrop.model.metrics.text import short_text
from evedrop.results.comparison import COMPARISON, Cell, Comparison, read_comparison
from evedrop.score.verdict import SecrecyOutcome
from evedrop.show.report.comparison import (
    comparison_lines,
    conclusion,
    pairs_table,
    schemes_done,
    schemes_table,
    verdict,
)
from evedrop.show.report.page import facts_table, made
from evedrop.show.report.travel import OF_PAGE, circumstances, download, input_files
from evedrop.show.view.palette import VERDICTS, hexadecimal
from evedrop.system.files import Unreadable, text_of

_INK = {SecrecyOutcome.PERFECT: "#fff"}
_DARK = "#16191d"
_MOST_BYTES = 2**20


@dataclass(frozen=True)
class ComparisonSource:
    """The folder of a comparison, read."""

    folder: Path
    comparison: Comparison

    @classmethod
    def read(cls, folder: Path) -> ComparisonSource:
        """Read a folder. Raises UsageError if it is not that of a comparison."""
        return cls(folder, read_comparison(folder))

    @property
    def outcome(self) -> str:
        """How many pairs have each verdict, as a sentence, and how many schemes were done if not all."""
        verdicts = [cell.verdict for scheme in self.comparison.schemes.values() for cell in scheme.cells.values()]
        counts = [(word, verdicts.count(word)) for word in SecrecyOutcome]
        counted = ", ".join(f"{count:,} {word.value}" for word, count in counts if count)
        done = schemes_done(self.comparison)
        more = f"; {done}" if done else ""
        return f"Secrecy of {sum(count for _, count in counts):,} pairs of scheme and adversary: {counted}{more}"


def _matrix(of: ComparisonSource) -> Iterator[Markup]:
    """The verdict on each scheme against each adversary."""
    yield verdicts_matrix(of.comparison)


def verdicts_matrix(comparison: Comparison, glyphs: bool = False) -> Markup:
    """The verdict on each scheme against each adversary that is defined with a scheme.

    glyphs: in place of the verdicts, their glyphs, which the caption explains.
    """
    schemes = comparison.schemes.values()
    shown = [
        name for name in comparison.adversaries if any(scheme.cells[name].verdict is not None for scheme in schemes)
    ]
    meaning = f": {', '.join(f'{outcome.glyph} {outcome.value}' for outcome in SecrecyOutcome)}" if glyphs else ""
    caption = f"The adversary's error over the legitimate one, and the verdict on secrecy{meaning}; ·: not defined"
    if left_out := [name for name in comparison.adversaries if name not in shown]:
        caption += f", as against {', '.join(left_out)} for every scheme"
    rows = [(scheme.name, [_cell(scheme.cells[adversary], glyphs) for adversary in shown]) for scheme in schemes]
    return made("matrix", ["scheme", *shown], rows, caption)


def _cell(cell: Cell, glyphs: bool) -> Mapping[str, str | None]:
    """What the matrix shows of a pair."""
    kept = cell.verdict
    if kept is None:
        return {"verdict": None, "why": cell.match.not_defined}
    return {
        "verdict": f"{kept.glyph}\u00a0" if glyphs else verdict(cell),
        "ratio": f"{short_text(cell.ratio)}×",
        "ground": hexadecimal(VERDICTS[kept]),
        "ink": _INK.get(kept, _DARK),
    }


def _schemes(of: ComparisonSource) -> Iterator[Markup]:
    """What each scheme costs, and its closest adversary."""
    yield made("table", schemes_table(of.comparison), "Cost and secrecy of each scheme; errors ± standard errors")
    yield made("sentences", [conclusion(of.comparison), *comparison_lines(of.comparison)])


def _pairs(of: ComparisonSource) -> Iterator[Markup]:
    """The errors of every pair, with theory and z."""
    yield made(
        "table", pairs_table(of.comparison), "Errors ± standard errors, with theory; z: the z-score against theory"
    )


def _repeat(of: ComparisonSource) -> Iterator[Markup]:
    """The scenarios of the simulations to save, with the command that repeats each, and when and where they were made."""
    comparison, folder = of.comparison, of.folder / "scenarios"
    yield made(
        "paragraph",
        f"Seed {comparison.seed}, trials from {comparison.first_trial:,} on. Each simulation of the comparison again: save its "
        "scenario, and run it in its folder.",
    )
    yield from input_files(folder)
    files, commands = list[Markup](), list[str]()
    for path in sorted(folder.glob("*.toml")):
        with contextlib.suppress(OSError, Unreadable):
            files.append(download(path.name, text_of(path, _MOST_BYTES)))
            commands.append(f"evedrop montecarlo {shlex.quote(path.name)} --trials {comparison.trials}")
    yield made("details", f"The {len(files)} scenarios", made("block", *files, made("code", "\n".join(commands))))
    yield facts_table(circumstances(of.folder / COMPARISON), f"Date of the results; {OF_PAGE}")


COMPARISON_SECTIONS: Mapping[str, Callable[[ComparisonSource], Iterator[Markup]]] = {
    "Verdicts": _matrix,
    "Schemes": _schemes,
    "Pairs": _pairs,
    "Repeat it": _repeat,
}
"""Title → the function that makes the contents, in the order of the page."""
