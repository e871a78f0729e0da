"""Entries of results by name, with an error for an unknown name that lists the known ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar, final

from evedrop.errors import UnknownName

T = TypeVar("T")


@final
class ByName(dict[str, T]):
    """Entries of results by name. An unknown name raises UnknownName, a KeyError that lists the known ones."""

    def __init__(self, kind: str, entries: Mapping[str, T]) -> None:
        """what: the kind of entry, such as "receiver"."""
        super().__init__(entries)
        self._what = kind

    def __missing__(self, name: object) -> T:
        raise UnknownName(self._what, name, self)
