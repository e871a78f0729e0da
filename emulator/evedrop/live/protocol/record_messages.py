"""Records as parts of messages: packed and read by the declaration of their columns, with every check.

Each column is a binary field with the column's name: numbers as little-endian bytes, flags as bit masks.

Source: docs/protocol.md, messages.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Generic, TypeVar, final

import numpy as np

from evedrop.live.protocol.codec import Reader, binary
from evedrop.model.receiver import packed_flags
from evedrop.model.record import Record, RecordColumn, columns

Kind = TypeVar("Kind", bound=Record)


def packed(record: Record) -> dict[str, Any]:
    """The columns of a record that are there, as fields of a message."""
    fields: dict[str, Any] = {}
    for entry in columns(type(record)):
        array = getattr(record, entry.name)
        if array is not None:
            fields[entry.name] = binary(
                packed_flags(array) if entry.is_flag else array, "u1" if entry.is_flag else entry.dtype.str
            )
    return fields


@final
class RecordFormat(Generic[Kind]):
    """How messages carry one kind of record in a run."""

    def __init__(
        self,
        kind: type[Kind],
        extent: Mapping[str, int],
        absent: Collection[str] = (),
        present: Collection[str] = (),
        most: Mapping[str, int] | None = None,
    ) -> None:
        """extent: axis → its length in the run, without c.

        absent: optional columns that are not read; present: optional ones that must be there; most: column of whole numbers →
        its largest.
        """
        self._kind, self._most = kind, most or {}
        self._columns = [
            (entry, entry.shape(extent), entry.name in present or not entry.optional)
            for entry in columns(kind)
            if entry.name not in absent
        ]

    def read(self, message: Reader, first: int, count: int) -> Kind:
        """The record of some slots from `first` on. Raises MalformedMessage, with the sender and the column."""
        values: dict[str, Any] = {}
        for entry, shape, needed in self._columns:
            if needed or message.has(entry.name):
                values[entry.name] = self._column(message, entry, (count, *shape))
        return self._kind(first, **values)

    def _column(self, message: Reader, entry: RecordColumn, shape: tuple[int, ...]) -> Any:
        if entry.is_flag:
            return message.flags(entry.name, shape)
        if entry.dtype.kind == "f":
            return message.finite(entry.name, shape)
        return message.counts(entry.name, entry.dtype.str, shape, self._most.get(entry.name, np.iinfo(entry.dtype).max))
