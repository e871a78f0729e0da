"""The picture of a comparison: a matrix of schemes and adversaries, with a mark, a colour and a ratio in every cell."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.score.verdict import MARKS, SecrecyKept
from evedrop.show.view import palette
from evedrop.show.view.figure_style import drawing, panels
from evedrop.show.view.palette import hexadecimal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from evedrop.results.comparison import Cell, Comparison, SchemeResult
    from evedrop.show.view.shown_figure import ShownFigure

# Blue for secrecy kept, darker where perfect; orange for broken: distinct with any colour blindness, and in greyscale.
_GROUND = {
    SecrecyKept.PERFECT: hexadecimal(palette.PERFECT),
    SecrecyKept.RELATIVE: hexadecimal(palette.RELATIVE),
    SecrecyKept.UNDECIDED: hexadecimal(palette.UNDECIDED),
    SecrecyKept.BROKEN: hexadecimal(palette.BROKEN),
}
_INK = {
    SecrecyKept.PERFECT: "white",
    SecrecyKept.RELATIVE: "#10202e",
    SecrecyKept.UNDECIDED: "#3c3c3c",
    SecrecyKept.BROKEN: "#2a1200",
}
_SAID = {
    SecrecyKept.PERFECT: "perfect: its error grows without bound",
    SecrecyKept.RELATIVE: "relative: it stays above the legitimate error",
    SecrecyKept.UNDECIDED: "too few trials to tell",
    SecrecyKept.BROKEN: "broken",
}
_NOTABLE = 1.1  # the factor by which an attack must raise the user's error to be noted
_FACTS = ("legitimate\nerror", "ACKs", "bits\na slot", "energy\na slot", "secret bits\na slot (+ once)")
_FACT_WIDTH = 1.25
_LEFT = _FACT_WIDTH * len(_FACTS)
_LEAST_WIDTH = 9.0


def draw(path: Path, result: Comparison) -> None:
    """Draw a comparison as `path`.png and `path`.pdf. The PNG file names its rows and columns in its metadata."""
    with panels(path, 1, *_size(result), shown(result)) as (axes,):
        _draw_on(axes, result)


def shown(comparison: Comparison) -> dict[str, str]:
    """What the picture of a comparison shows, by keyword, as its PNG file says it: so that a kept picture can be checked."""
    return {
        "Rows": ",".join(comparison.schemes),
        "Columns": ",".join(comparison.adversaries),
        "Size": f"{comparison.slots} slots, {comparison.trials} trials, seed {comparison.seed}",
    }


def comparison_figure(comparison: Comparison) -> ShownFigure:
    """The picture of a comparison as a figure."""
    with drawing(*_size(comparison)) as figure:
        _draw_on(figure.subplots(), comparison)
    return figure


def _right(comparison: Comparison) -> float:
    """The right end of the picture: room for the adversaries, and for the legend."""
    return max(float(len(comparison.adversaries)) + 1.1, _LEAST_WIDTH)


def _size(comparison: Comparison) -> tuple[float, float]:
    """Width and height in inches."""
    return 0.92 * (_LEFT + _right(comparison) + 2.0), 2.3 + 0.56 * len(comparison.schemes)


def _draw_on(axes: Axes, comparison: Comparison) -> None:
    schemes, adversaries, left = list(comparison.schemes.values()), comparison.adversaries, _LEFT
    axes.set_axis_off()
    axes.set_xlim(-left - 2.0, _right(comparison))
    axes.set_ylim(len(schemes) + 1.6, -2.6)
    for row, scheme in enumerate(schemes):
        weight = "bold" if scheme.name in comparison.dominant else "normal"
        axes.text(-left - 0.1, row, scheme.name, ha="right", va="center", fontsize=10.5, fontweight=weight)
        for i, fact in enumerate(_facts(scheme)):
            place = -left + _FACT_WIDTH * (i + 0.5)
            axes.text(place, row, fact, ha="center", va="center", fontsize=9, color="#33383d")
        for column, adversary in enumerate(adversaries):
            _cell(axes, column, row, scheme, scheme.cells[adversary])
    for i, head in enumerate(_FACTS):
        axes.text(-left + _FACT_WIDTH * (i + 0.5), -0.62, head, ha="center", va="bottom", fontsize=9)
    for column, adversary in enumerate(adversaries):
        axes.text(column + 0.42, -0.62, adversary, ha="left", va="bottom", fontsize=9.5, rotation=38)
    _legend(axes, comparison, left)


def _facts(scheme: SchemeResult) -> Iterator[str]:
    needs = scheme.needs
    error = scheme.legitimate.standard_error
    yield _number(scheme.legitimate.typical) + (f"\n± {_number(error)}" if error else "")
    yield "needed" if needs.acknowledgements else "–"
    yield _number(needs.bits_per_slot)
    yield f"{needs.energy_per_slot:.3g}"
    once = f" (+ {needs.initial_secret_bits})" if needs.initial_secret_bits else ""
    yield f"{needs.secret_bits_per_slot}{once}" if needs.secret_bits_per_slot else "–"


def _cell(axes: Axes, column: int, row: int, scheme: SchemeResult, cell: Cell) -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - slow to import, and needed only for this picture

    box: Any = {"xy": (column + 0.03, row - 0.47), "width": 0.94, "height": 0.94, "linewidth": 0}
    word = cell.verdict
    if word is None or cell.ratio is None or cell.legitimate is None:
        axes.add_patch(Rectangle(**box, facecolor="white"))
        axes.text(column + 0.5, row, "·", ha="center", va="center", color="#9aa0a6", fontsize=9)
        return
    axes.add_patch(Rectangle(**box, facecolor=_GROUND[word]))
    axes.text(column + 0.5, row - 0.17, MARKS[word], ha="center", va="center", color=_INK[word], fontsize=11)
    user = cell.legitimate.typical / scheme.legitimate.typical if scheme.legitimate.typical else math.inf
    raised = f"  u×{_number(user)}" if user > _NOTABLE else ""
    size = 7.2 if raised else 8.4
    axes.text(
        column + 0.5,
        row + 0.24,
        f"{_number(cell.ratio)}×{raised}",
        ha="center",
        va="center",
        color=_INK[word],
        fontsize=size,
    )


def _legend(axes: Axes, comparison: Comparison, left: float) -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - as above

    rows = len(comparison.schemes)
    place = -left - 1.9
    for word, meaning in _SAID.items():
        axes.add_patch(Rectangle((place, rows - 0.12), 0.42, 0.44, facecolor=_GROUND[word], linewidth=0))
        axes.text(place + 0.21, rows + 0.1, MARKS[word], ha="center", va="center", color=_INK[word], fontsize=9.5)
        axes.text(place + 0.52, rows + 0.1, meaning, ha="left", va="center", fontsize=8.8)
        place += 1.0 + 0.092 * len(meaning)
    notes = [
        f"{comparison.title}: {comparison.slots:,} slots, {comparison.trials:,} trial{'s' if comparison.trials > 1 else ''}.",
        "n×: the adversary's over the legitimate error. u×: an attack raises the legitimate error. ·: not defined."
        + (f" Bold: dominates ({', '.join(comparison.dominant)})." if comparison.dominant else ""),
    ]
    axes.text(-left - 1.9, rows + 0.55, "\n".join(notes), ha="left", va="top", fontsize=8.8, linespacing=1.5)


def _number(value: float) -> str:
    """A number in short form: 2.3, 57, 3.4e5."""
    if not math.isfinite(value):
        return "∞"
    if 0.01 <= value < 1e4:
        return f"{value:.0f}" if value >= 100 else f"{value:.2g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"
