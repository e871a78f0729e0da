"""Records: what one process knows of c consecutive slots of R trials. A column is declared once, an operation written once.

A record is a frozen dataclass whose columns say their axes, type and meaning. Messages, tables and the scorekeeper use the
same objects: `live/protocol/record_messages.py` packs and reads any record by its declaration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray


class RecordColumn(NamedTuple):
    """A column of a record."""

    name: str
    axes: tuple[str, ...]
    """The name of each axis: the first is c, the slots; R are the trials."""
    dtype: np.dtype[Any]
    meaning: str
    optional: bool
    """Whether the column may be None."""

    @property
    def is_flag(self) -> bool:
        """Whether its values are true or false."""
        return self.dtype.kind == "b"

    def slot_bytes(self, extent: Mapping[str, int]) -> int:
        """The bytes of one slot's values in a message, flags as bit masks; extent: as for `shape`."""
        *outer, last = self.shape(extent) or (1,)
        return math.prod(outer) * ((last + 7) // 8 if self.is_flag else last * self.dtype.itemsize)

    def shape(self, extent: Mapping[str, int]) -> tuple[int, ...]:
        """The shape of one slot's values; extent: axis → its length, unless the axis is a number itself."""
        return tuple(int(axis) if axis.isdigit() else extent[axis] for axis in self.axes[1:])


def column(axes: str, meaning: str, dtype: str = "<f8", **default: None) -> Any:
    """Declare a column of a record.

    axes: their names, "c" first, separated by blanks; dtype: "?" for flags. A column that may be missing has `default=None`.
    """
    metadata = {"axes": tuple(axes.split()), "dtype": np.dtype(dtype), "meaning": meaning}
    return field(**default, metadata=metadata)  # type: ignore[call-overload]


def columns(kind: type[Record]) -> tuple[RecordColumn, ...]:
    """The columns of a kind of record, in the order of their declaration."""
    hashable: Any = kind  # mypy takes a class whose instances cannot be hashed for one
    return _columns(hashable)


@cache
def _columns(kind: Any) -> tuple[RecordColumn, ...]:
    return tuple(
        RecordColumn(entry.name, **entry.metadata, optional=entry.default is None)
        for entry in fields(kind)
        if "axes" in entry.metadata
    )


@dataclass(frozen=True, eq=False)
class Record:
    """The base of all records: a subclass is a frozen dataclass of columns."""

    first: int
    """The first slot."""

    def __init_subclass__(cls) -> None:
        """Note the column that every record of this kind has."""
        cls._leading = next(iter(cls.__annotations__))

    _leading: ClassVar[str]

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(getattr(self, self._leading))

    @property
    def slots(self) -> range:
        """The slots."""
        return range(self.first, self.first + self.count)

    def arrays(self) -> Any:
        """The columns that are there, in order."""
        values = (getattr(self, entry.name) for entry in columns(type(self)))
        return (array for array in values if array is not None)

    def mapped(self, change: Callable[[RecordColumn, NDArray[Any]], NDArray[Any]], first: int | None = None) -> Self:
        """The record with every column that is there changed; first: its first slot, if that changes."""
        changed = {
            entry.name: change(entry, array)
            for entry in columns(type(self))
            if (array := getattr(self, entry.name)) is not None
        }
        return self.changed(first=self.first if first is None else first, **changed)

    def changed(self, **entries: Any) -> Self:
        """The record with other columns. As `dataclasses.replace`, in a third of the time: it is called for single slots."""
        made = object.__new__(type(self))
        vars(made).update(vars(self), **entries)
        return made

    def rows(self, some: slice) -> Self:
        """Some of the slots, as views."""
        if some == slice(0, self.count):
            return self
        return self.mapped(lambda _, array: array[some], self.first + (some.start or 0))

    def part(self, trials: slice) -> Self:
        """Some of the trials, as views. Columns without trials stay as they are."""
        return self.mapped(lambda entry, array: array[..., trials] if entry.axes[-1] in TRIALS else array)

    def copied(self) -> Self:
        """A copy whose arrays are its own, so that it does not keep larger ones in memory."""
        return self.mapped(lambda _, array: array.copy())

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Records of consecutive slots, at least one, as one. Raises ValueError if only some of them have a column."""
        if len(parts) == 1:
            return parts[0]
        whole: dict[str, Any] = {}
        for entry in columns(cls):
            arrays = [getattr(part, entry.name) for part in parts]
            there = [array for array in arrays if array is not None]
            if there and len(there) < len(arrays):
                raise ValueError(f"only some of the slots from {parts[0].first} on have {entry.name}: {entry.meaning}")
            whole[entry.name] = np.concatenate(there) if there else None
        return parts[0].changed(**whole)


def largest_bytes(kind: type[Record], count: int, extent: Mapping[str, int]) -> int:
    """The bytes of all columns of some slots as they are in messages, with their names; extent: as for `RecordColumn.shape`."""
    return sum(len(entry.name) + _COLUMN_BYTES + count * entry.slot_bytes(extent) for entry in columns(kind))


_COLUMN_BYTES = 8  # of the frame of a column in a message

TRIALS = ("R", "S")
"""Axes of trials: R of all of them, S of those that are recorded."""
