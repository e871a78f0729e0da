"""The base class of papers, and their numbers with ours: agreement, erratum, or the reason why they cannot be compared.

Source: docs/papers.md, how to read a verdict.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, ClassVar, Self, TypeAlias

from evedrop.model.metrics.text import ShownNumber, estimate

Progress: TypeAlias = Callable[[str], None]
"""Receives a line for each step of a computation."""


def silent(_: str) -> None:
    """Ignore a progress report."""


class Paper(ABC):
    """A paper whose numbers can be computed. A subclass has no arguments; it is registered in `PAPERS`."""

    title: ClassVar[str]
    authors: ClassVar[str]
    published: ClassVar[str]
    """Where and when, and where its code is if it is public."""
    text_read: ClassVar[bool] = False
    """Whether we have read the text of the paper; without it, no number of it has the verdict `erratum`."""

    @abstractmethod
    def rows(self, quick: bool, progress: Progress) -> Iterable[PublishedNumber]:
        """Every number of the paper, in the paper's order, with ours and a verdict.

        quick: simulate so little that all rows take seconds; verdicts by standard errors still hold then. progress: call it with
        a line before each step that takes seconds.
        """


Value: TypeAlias = float | str | None
"""A number; text for anything else, such as a range; None if there is nothing."""


class NumberVerdict(StrEnum):
    """What the comparison of one number says."""

    AGREES = "agrees"
    """The number is published, and the difference is within the tolerance."""
    FORMULA = "formula"
    """No number is published: ours, by simulation, is within the tolerance of our own evaluation of its formula."""
    ERRATUM = "erratum"
    """The difference is larger, and the reason says why the paper, whose text we have read, is wrong."""
    PROGRAM = "program differs"
    """The number is that of a published program whose paper we have not read; the reason says why ours is another."""
    NOT_PUBLIC = "not public"
    """The data needed to compute or to compare the number is not published."""
    NOT_COMPARABLE = "not comparable"
    """The two numbers are not estimates of the same thing, or one of them is too uncertain."""
    DIFFERS = "differs"
    """The difference is larger than the tolerance, and there is no explanation."""


@dataclass(frozen=True)
class PublishedNumber:
    """One number of a paper, and ours."""

    where: str
    """Where in the paper, such as "Fig. 3" or "Table 1"."""
    quantity: str
    """What the number is, with the parameters."""
    theirs: Value
    ours: Value
    standard_error: float | None
    """Of ours; None if it is exact: it comes from theory."""
    tolerance: str
    """What was allowed, such as "2 %"; empty if nothing was compared."""
    verdict: NumberVerdict
    reason: str = ""
    """A sentence, for every verdict but `agrees`, `formula` and `differs`."""
    printed: bool = True
    """Whether `theirs` is published, in the paper, its slides or its program; otherwise it is our evaluation of a formula."""

    @property
    def compares_print(self) -> bool:
        """Whether a published number was compared with ours."""
        decided = {NumberVerdict.AGREES, NumberVerdict.ERRATUM, NumberVerdict.PROGRAM, NumberVerdict.DIFFERS}
        return self.printed and self.theirs is not None and self.verdict in decided

    @classmethod
    def compared(
        cls,
        where: str,
        quantity: str,
        theirs: float,
        ours: float,
        standard_error: float | None = None,
        *,
        relative: float | None = None,
        absolute: float | None = None,
        errors: float | None = None,
        their_error: float = 0.0,
        erratum: str = "",
        printed: bool = True,
    ) -> Self:
        """Compare two numbers. They agree if they differ by no more than any of the tolerances given.

        relative: as a fraction of theirs; absolute: in units of the number; errors: in standard errors of the difference.
        their_error: the standard error of theirs, 0 if it is exact. erratum: the reason, where a larger difference is known to be
        the paper's mistake. printed: False if theirs is our evaluation of the paper's formula.

        Raises ValueError if no tolerance is given.
        """
        words, bounds = [], []
        if relative is not None:
            words.append(f"{100.0 * relative:g} %")
            bounds.append(relative * abs(theirs))
        if absolute is not None:
            words.append(f"± {absolute:g}")
            bounds.append(absolute)
        if errors is not None:
            words.append(f"{errors:g} standard errors")
            bounds.append(errors * math.hypot(standard_error or 0.0, their_error))
        if not bounds:
            raise ValueError(f"{where}, {quantity}: no tolerance; expected relative, absolute or errors")
        agrees = abs(ours - theirs) <= max(bounds)
        same = NumberVerdict.AGREES if printed else NumberVerdict.FORMULA
        otherwise = NumberVerdict.ERRATUM if erratum else NumberVerdict.DIFFERS
        return cls(
            where, quantity, theirs, ours, standard_error, " or ".join(words),
            same if agrees else otherwise, "" if agrees else erratum, printed,
        )  # fmt: skip

    @classmethod
    def stated(
        cls, where: str, quantity: str, theirs: Value, ours: Value, verdict: NumberVerdict, reason: str = "",
        standard_error: float | None = None, *, printed: bool = True,
    ) -> Self:  # fmt: skip
        """A row whose verdict no tolerance decides; printed: as for `compared`.

        Raises ValueError for a verdict without the reason that it needs.
        """
        if not reason and verdict not in {NumberVerdict.AGREES, NumberVerdict.FORMULA}:
            raise ValueError(f"{where}, {quantity}: the verdict {verdict} needs a reason")
        return cls(where, quantity, theirs, ours, standard_error, "", verdict, reason, printed)

    @property
    def their_text(self) -> str:
        """The paper's value as text."""
        return _text(self.theirs)

    @property
    def our_text(self) -> str:
        """Our value with its standard error, or "exact", as text."""
        if not isinstance(self.ours, float):
            return _text(self.ours)
        return _text(self.ours) + " exact" if self.standard_error is None else estimate(self.ours, self.standard_error)


def _strict(value: Any) -> Any:
    """A value as JSON knows it: it has no infinity."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _text(value: Value) -> str:
    if value is None:
        return "–"
    return value if isinstance(value, str) else ShownNumber(f"{value:.6g}".replace("inf", "∞"), value)


@dataclass(frozen=True)
class Reproduction:
    """A paper with all its numbers compared."""

    name: str
    title: str
    authors: str
    published: str
    quick: bool
    rows: tuple[PublishedNumber, ...]

    @property
    def differing(self) -> tuple[PublishedNumber, ...]:
        """The rows that neither agree nor have an explanation."""
        return tuple(row for row in self.rows if row.verdict is NumberVerdict.DIFFERS)

    @property
    def counts(self) -> dict[str, int]:
        """Verdict → number of rows, for the verdicts that occur."""
        counts = {str(verdict): sum(row.verdict is verdict for row in self.rows) for verdict in NumberVerdict}
        return {name: count for name, count in counts.items() if count}

    @property
    def printed_compared(self) -> int:
        """How many published numbers were compared with ours."""
        return sum(row.compares_print for row in self.rows)

    @property
    def scope(self) -> str:
        """How many published numbers were compared, as a sentence."""
        count = self.printed_compared
        if not count:
            return "No published number was compared: none was available."
        return f"{count} published {'number was' if count == 1 else 'numbers were'} compared."

    def as_dict(self) -> dict[str, Any]:
        """The content of `NAME.json`."""
        rows = [{key: _strict(value) for key, value in asdict(row).items()} for row in self.rows]
        return {**asdict(self), "rows": rows, "counts": self.counts, "printed_compared": self.printed_compared}

    def as_markdown(self) -> str:
        """The content of `NAME.md`: the table, with reasons."""
        lines = [
            f"# {self.title}",
            "",
            f"{self.authors}. {self.published}.",
            "",
            self.scope,
            "",
            markdown_table(self.rows),
        ]
        return "\n".join(lines) + "\n"


def markdown_table(rows: Iterable[PublishedNumber]) -> str:
    """The numbers with their verdicts and reasons."""
    lines = ["| where | what | theirs | ours | tolerance | verdict |", "|---|---|---|---|---|---|"]
    for row in rows:
        verdict = f"{row.verdict}: {row.reason}" if row.reason else str(row.verdict)
        cells = (row.where, row.quantity, row.their_text, row.our_text, row.tolerance or "–", verdict)
        lines.append(f"| {' | '.join(cell.replace('|', '∣') for cell in cells)} |")
    return "\n".join(lines)
