"""The base class of papers.

Source: docs/papers.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import ClassVar, TypeAlias

from evedrop.studies.papers.reproduction import PublishedNumber

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
