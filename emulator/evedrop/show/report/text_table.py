"""A table of texts: the terminal and the page format it differently, and a file has it as CSV or LaTeX.

In CSV, every number is at full precision; in LaTeX, it is as it is shown.

Source: docs/export.md, tables.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from evedrop.errors import UsageError
from evedrop.model.metrics.text import ShownNumber, scientific
from evedrop.score.verdict import SecrecyOutcome


@dataclass(frozen=True)
class TextColumn:
    """The head of a column."""

    heading: str
    number: bool = True
    """Whether its cells are numbers, which are aligned to the right."""
    wraps: bool = False
    """Whether the terminal may break its cells into lines."""


@dataclass
class TextTable:
    """Columns and rows. A first cell that is empty repeats the one above it."""

    columns: Sequence[TextColumn]
    rows: list[tuple[str, ...]] = field(default_factory=list)
    title: str = ""
    least: Sequence[str] = ()
    """The headings of the columns that a narrow terminal leaves out first; after them it goes from right to left."""

    @classmethod
    def headed(
        cls,
        words: Sequence[str],
        numbers: Sequence[str],
        after: Sequence[str] = (),
        title: str = "",
        wrapped: Collection[str] = (),
        least: Sequence[str] = (),
    ) -> TextTable:
        """A table without rows: columns of words, then of numbers, then again of words.

        wrapped: the headings of the columns that may wrap; least: as the attribute.
        """
        heads = (
            [(head, False) for head in words] + [(head, True) for head in numbers] + [(head, False) for head in after]
        )
        return cls([TextColumn(head, number, head in wrapped) for head, number in heads], title=title, least=least)

    def add(self, *cells: str) -> None:
        """Add a row."""
        self.rows.append(cells)

    def under(self, heading: str, word: str) -> TextTable:
        """The same table with a first column of this heading that has the word in every row."""
        columns, rows = [TextColumn(heading, number=False), *self.columns], [(word, *row) for row in self.rows]
        return replace(self, columns=columns, rows=rows)


_SMALL, _LARGE, _DUST = 1e-3, 1e5, 1e-12
_FAR = 4.0
"""A z beyond it is marked: theory that is right gives it once in 16,000 receivers."""


def aligned(table: TextTable) -> TextTable:
    """The same table, in which the numbers of a column all have an exponent if any of them is very small or large.

    A z never has one.
    """
    columns = [[*cells] for cells in zip(*table.rows, strict=True)]
    for cells, column in zip(columns, table.columns, strict=False):  # without rows there are no cells
        if column.heading == "z":
            continue
        values = [cell.value for cell in cells if isinstance(cell, ShownNumber) and isinstance(cell.value, float)]
        sizes = [abs(value) for value in values if value and math.isfinite(value)]
        largest = max(sizes, default=0.0)
        smallest = min((size for size in sizes if size > _DUST * largest), default=1.0)
        if smallest < _SMALL or largest >= _LARGE:
            cells[:] = [_with_exponent(cell) for cell in cells]
    return replace(table, rows=list(zip(*columns, strict=True)))


def _with_exponent(cell: str) -> str:
    if not isinstance(cell, ShownNumber) or not isinstance(cell.value, float):
        return cell
    text = cell.removesuffix(cell.after)
    if cell.after and text == cell:  # words before the number, such as "≥"
        return cell
    return ShownNumber(scientific(cell.value, cell.error), cell.value, cell.error) + cell.after


def far(table: TextTable) -> set[tuple[int, int]]:
    """Row and column of each z-score that is beyond 4."""
    of_z = [i for i, column in enumerate(table.columns) if column.heading == "z"]
    return {
        (row, i)
        for row, cells in enumerate(table.rows)
        for i in of_z
        if isinstance(cell := cells[i], ShownNumber) and cell.value is not None and abs(cell.value) > _FAR
    }


ERROR, NOTE = "standard error", "note"
"""What the heading of a column says after that of its numbers."""
_EMPTY = {"–", ""}


def csv_text(table: TextTable) -> str:
    """The table as CSV: numbers as Python writes them; their standard errors and what follows them have their own columns.

    A cell without a value is empty; a first cell that repeats the one above it is written out.
    """
    columns = [[*cells] for cells in zip(*_whole_rows(table), strict=True)] or [[] for _ in table.columns]
    heads: list[str] = []
    written: list[Sequence[str]] = []
    for heading, cells in zip(_distinct([number.heading for number in table.columns]), columns, strict=True):
        numbers = [cell if isinstance(cell, ShownNumber) else ShownNumber(cell, None) for cell in cells]
        heads.append(heading)
        written.append([_value(cell) for cell in cells])
        if any(number.error is not None for number in numbers):
            heads.append(f"{heading} {ERROR}")
            written.append(["" if number.error is None else repr(float(number.error)) for number in numbers])
        if any(number.after for number in numbers):
            heads.append(f"{heading} {NOTE}")
            written.append([number.after.strip() for number in numbers])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(zip(*written, strict=True))
    return out.getvalue()


def _value(cell: str) -> str:
    if isinstance(cell, ShownNumber):
        value = cell.value
        return "" if value is None else repr(value if isinstance(value, int) else float(value))
    return "" if cell in _EMPTY else cell


def _whole_rows(table: TextTable) -> list[tuple[str, ...]]:
    """The rows; a first cell that is empty is the one above it."""
    rows: list[tuple[str, ...]] = []
    for first, *others in table.rows:
        rows.append((first or (rows[-1][0] if rows else ""), *others))
    return rows


def _distinct(heads: Sequence[str]) -> list[str]:
    """The headings; one that another column has too gets the heading before it, or a number."""
    names_: list[str] = []
    for i, head in enumerate(heads):
        name = head if heads.count(head) == 1 or not i else f"{heads[i - 1]}: {head}"
        count = 2
        while name in names_:
            name, count = f"{head} {count}", count + 1
        names_.append(name)
    return names_


def latex_text(table: TextTable) -> str:
    r"""The table as a `tabular` of LaTeX, which needs no package; \hline above, below its heads, and at its end.

    It has no digests, which mean nothing on paper.
    """
    table = _without(table, "digest")
    kinds = "".join("r" if column.number else "l" for column in table.columns)
    lines = [
        *([f"% {' '.join(table.title.split())}"] if table.title else []),
        rf"\begin{{tabular}}{{{kinds}}}",
        r"\hline",
        _row([column.heading for column in table.columns]),
        r"\hline",
        *(_row(row) for row in table.rows),
        r"\hline",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _without(table: TextTable, heading: str) -> TextTable:
    """The table without the column of this heading, if it has one."""
    kept = [i for i, column in enumerate(table.columns) if column.heading != heading]
    rows = [tuple(row[i] for i in kept) for row in table.rows]
    return replace(table, columns=[table.columns[i] for i in kept], rows=rows)


def _row(cells: Sequence[str]) -> str:
    row = " & ".join(latex_escaped(_MARKS.sub("", cell)) for cell in cells) + r" \\"
    return (
        "{}" + row if row.startswith(("[", "*")) else row
    )  # the row above ends with a command that takes these as arguments


_MARKS = re.compile(f"^[{''.join(outcome.glyph for outcome in SecrecyOutcome)}] ")
"""The mark of a verdict before its word, for which LaTeX needs a package or a font."""


_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$", '"': "''", "’": "'",
    "−": "$-$", "–": "--", "—": "---", "±": r"$\pm$", "×": r"$\times$", "·": r"$\cdot$", "∞": r"$\infty$", "≥": r"$\geq$",
    "≤": r"$\leq$", "≈": r"$\approx$", "→": r"$\to$", "∈": r"$\in$", "∪": r"$\cup$", "√": r"$\surd$", "…": r"\ldots{}",
    "µ": r"$\mu$", "½": "$1/2$", "°": r"$^{\circ}$", "€": "EUR", "‰": r"$0/00$", "ᵀ": "$^{T}$", "\u00a0": "~", "\u202f": "~",
}  # fmt: skip
_ACCENTS = {
    "\N{COMBINING CIRCUMFLEX ACCENT}": r"\hat",
    "\N{COMBINING TILDE}": r"\tilde",
    "\N{COMBINING MACRON}": r"\bar",
}
_POWERS = re.compile(r"([\^_])(?:\{[^{}]*\}\$\$\1)+\{")  # exponents, or indices, one after the other are a single one
_NO_COMMAND = {
    "omicron": "o", "Alpha": "A", "Beta": "B", "Epsilon": "E", "Zeta": "Z", "Eta": "H", "Iota": "I", "Kappa": "K", "Mu": "M",
    "Nu": "N", "Omicron": "O", "Rho": "P", "Tau": "T", "Chi": "X",
}  # fmt: skip


def latex_escaped(text: str) -> str:
    """A text that LaTeX shows as it is: Greek letters, x̂, ± and ∞ as mathematics, and its own characters escaped."""
    parts: list[str] = []
    for character in unicodedata.normalize("NFD", text):
        if character in _ACCENTS and parts:
            parts.append(f"${_ACCENTS[character]}{{{parts.pop().strip('$')}}}$")
        else:
            parts.append(_escaped(character))
    whole = _POWERS.sub(lambda match: match[0].replace(f"}}$${match[1]}{{", ""), "".join(parts))
    return unicodedata.normalize("NFC", whole.replace("$$", ""))


def _escaped(character: str) -> str:
    if character in _SPECIAL:
        return _SPECIAL[character]
    if character.isascii():
        return character if character.isprintable() else " "
    name = unicodedata.name(character, "").split()
    if name[:1] == ["GREEK"] and "LETTER" in name:
        letter = name[-1].lower() if "SMALL" in name else name[-1].capitalize()
        letter = letter.replace("amda", "ambda")
        return f"${_NO_COMMAND.get(letter, chr(92) + letter + ' ')}$".replace(" $", "$")
    kind, _, plain = unicodedata.decomposition(character).partition(" ")
    if kind in {"<super>", "<sub>"}:
        shown = "".join(latex_escaped(chr(int(code, 16))) for code in plain.split()).strip("$")
        return f"${'^' if kind == '<super>' else '_'}{{{shown}}}$"
    return character  # a letter with an accent is put together again by inputenc


def write_csv(tables: Sequence[TextTable], path: Path) -> list[Path]:
    """Write tables as CSV: the first to `path`, the second to NAME-2.csv beside it, and so on; returns the paths.

    Raises UsageError if a file cannot be written.
    """
    paths = [path, *(path.with_name(f"{path.stem}-{number}{path.suffix}") for number in range(2, len(tables) + 1))]
    for target, table in zip(paths, tables, strict=False):
        _write(target, csv_text(table))
    return paths[: len(tables)]


def write_latex(tables: Sequence[TextTable], path: Path) -> Path:
    """Write tables as LaTeX, one after the other, to one file; returns its path. Raises UsageError if it cannot be written."""
    _write(path, "\n".join(map(latex_text, tables)))
    return path


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another file") from error
