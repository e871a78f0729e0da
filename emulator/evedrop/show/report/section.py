"""The base class of a report's sections: each makes its part of the page from the results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar, Generic, TypeVar

from evedrop.errors import UsageError
from evedrop.show.report.markup import Node, element
from evedrop.show.report.page import Part

SourceT = TypeVar("SourceT")


class Section(ABC, Generic[SourceT]):
    """A section about the results of one kind, such as a run or a sweep. A class, never an instance, is registered."""

    title: ClassVar[str]

    @classmethod
    @abstractmethod
    def nodes(cls, of: SourceT) -> Iterator[Node]:
        """Its contents; none if these results have nothing to show in it; it is then left out."""

    @classmethod
    def part(cls, of: SourceT) -> Part | None:
        """Its part of the page; None if it is left out. If tables cannot be read, it says why."""
        try:
            nodes = list(cls.nodes(of))
        except UsageError as error:
            nodes = [element("p", f"not shown: {error}")]
        return Part(cls.title, nodes) if nodes else None


def parts_of(sections: tuple[type[Section[SourceT]], ...], of: SourceT) -> list[Part]:
    """The parts of some sections, in order, without those that are left out."""
    return [part for part in (section.part(of) for section in sections) if part is not None]
