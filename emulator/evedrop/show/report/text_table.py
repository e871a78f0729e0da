"""A table of texts, which the terminal and the page format differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class TextColumn:
    """The head of a column."""

    heading: str
    number: bool = True
    """Whether its cells are numbers, which are aligned to the right."""


@dataclass
class TextTable:
    """Columns and rows. A first cell that is empty repeats the one above it."""

    columns: Sequence[TextColumn]
    rows: list[tuple[str, ...]] = field(default_factory=list)
    title: str = ""

    @classmethod
    def headed(
        cls, words: Sequence[str], numbers: Sequence[str], after: Sequence[str] = (), title: str = ""
    ) -> TextTable:
        """A table without rows: columns of words, then of numbers, then again of words."""
        return cls(
            [
                *(TextColumn(heading, number=False) for heading in words),
                *(TextColumn(heading) for heading in numbers),
                *(TextColumn(heading, number=False) for heading in after),
            ],
            title=title,
        )

    def add(self, *cells: str) -> None:
        """Add a row."""
        self.rows.append(cells)
