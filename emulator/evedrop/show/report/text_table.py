"""A table of texts, which the terminal and the page format differently."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field


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

    @classmethod
    def headed(
        cls,
        words: Sequence[str],
        numbers: Sequence[str],
        after: Sequence[str] = (),
        title: str = "",
        wrapped: Collection[str] = (),
    ) -> TextTable:
        """A table without rows: columns of words, then of numbers, then again of words; wrapped: the headings that may wrap."""
        heads = (
            [(head, False) for head in words] + [(head, True) for head in numbers] + [(head, False) for head in after]
        )
        return cls([TextColumn(head, number, head in wrapped) for head, number in heads], title=title)

    def add(self, *cells: str) -> None:
        """Add a row."""
        self.rows.append(cells)
