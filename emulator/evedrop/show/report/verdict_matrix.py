"""The matrix of a comparison in characters: a mark for each scheme and adversary, whose columns have letters.

Source: docs/compare.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from string import ascii_letters
from typing import TYPE_CHECKING

from evedrop.score.verdict import SecrecyOutcome

if TYPE_CHECKING:
    from evedrop.results.comparison import Comparison

_NOT_DEFINED = "·"


def matrix_lines(comparison: Comparison, columns: int) -> Iterator[str]:
    """A line for each scheme, with a mark for each adversary that is defined with a scheme; then what letters and marks mean.

    Only the explanations may be longer than `columns`. Adversaries that do not fit beside each other are in another block below.
    """
    schemes = comparison.schemes
    cells = {name: {who: cell.verdict for who, cell in scheme.cells.items()} for name, scheme in schemes.items()}
    adversaries = [who for who in comparison.adversaries if any(row.get(who) for row in cells.values())]
    width = min(max(map(len, cells), default=0), columns // 2)
    step = 2 if width + 2 * len(adversaries) <= columns else 1
    most = max(1, min(len(ascii_letters), (columns - width - 1) // step))
    for first in range(0, len(adversaries), most):
        block = adversaries[first : first + most]
        letters = ascii_letters[first:][: len(block)] if first + most <= len(ascii_letters) else ascii_letters
        space = " " * (step - 1)
        yield " " * (width + 1) + space.join(letters[: len(block)])
        for name, row in cells.items():
            short = name if len(name) <= width else f"{name[: width - 1]}…"
            yield f"{short:<{width}} " + space.join(_mark(row.get(who)) for who in block)
        yield ", ".join(f"{letter}={who}" for letter, who in zip(letters, block, strict=False))
    yield "  ".join(f"{outcome.glyph}={outcome.value}" for outcome in SecrecyOutcome) + f"  {_NOT_DEFINED}=not defined"
    if never := [who for who in comparison.adversaries if who not in adversaries]:
        yield f"not defined with any of these schemes: {', '.join(never)}"


def _mark(verdict: SecrecyOutcome | None) -> str:
    return _NOT_DEFINED if verdict is None else verdict.glyph
