"""Consecutive slots joined into one, with every column of every part."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.model.record import Record, columns
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots
from evedrop.score.slots import Slots, concatenated

EXTENT = {"n": 2, "m": 1, "R": 3, "S": 3, "F": 8}


def every(kind: type[Record], first: int = 4, count: int = 6) -> Any:
    """A record with different numbers in every column that it may have."""
    rng = np.random.default_rng(len(kind.__name__))
    arrays = {
        column.name: (100 * rng.random((count, *column.shape(EXTENT)))).astype(column.dtype) for column in columns(kind)
    }
    return kind(first, **arrays)


def whole() -> Slots:
    """Six slots with every column that slots can have."""
    return Slots(every(SensorSlots), {"eve": every(ReceiverSlots)}, {"eve": every(LinkSlots)})


def part(slots: Slots, rows: slice) -> Slots:
    """Some of the slots."""
    return slots.mapped(lambda record: record.rows(rows))


def records(slots: Slots) -> dict[str, Record]:
    """Path → record."""
    return {"sensor": slots.sensor, **{f"receiver {name}": record for name, record in slots.receivers.items()},
            **{f"link {name}": record for name, record in slots.links.items()}}  # fmt: skip


def entries(slots: Slots) -> dict[str, Any]:
    """Path of every column → its numbers."""
    return {
        f"{path} {column.name}": getattr(record, column.name).ravel().tolist()
        for path, record in records(slots).items()
        for column in columns(type(record))
        if getattr(record, column.name) is not None
    }


def test_every_column_is_kept() -> None:
    """Slots that were cut into pieces are the same again when they are joined."""
    of_parts = [part(whole(), rows) for rows in (slice(0, 1), slice(1, 5), slice(5, 6))]
    assert [slots.first for slots in of_parts] == [4, 5, 9]
    assert len(entries(whole())) == 19
    joined = concatenated(of_parts)
    assert entries(joined) == entries(whole())
    assert (joined.first, joined.count, joined.trials, joined.recorded) == (4, 6, 3, 3)


@pytest.mark.parametrize("name", [column.name for column in columns(SensorSlots) if column.optional])
def test_a_column_that_only_some_parts_have_is_refused(name: str) -> None:
    """It cannot be joined, and is not left out silently."""
    first, second = (part(whole(), rows) for rows in (slice(0, 3), slice(3, 6)))
    nothing: dict[str, Any] = {name: None}
    without = [replace(slots, sensor=replace(slots.sensor, **nothing)) for slots in (first, second)]
    with pytest.raises(ValueError, match=f"only some of the slots from 4 on have {name}: "):
        concatenated([first, without[1]])
    assert getattr(concatenated(without).sensor, name) is None


def test_a_part_of_the_trials_has_their_columns() -> None:
    """Of every column that has trials; what is counted over trials stays."""
    some = slice(1, 3)
    of_some, all_of = entries(whole().part(some)), whole()
    assert of_some["sensor x"] == all_of.sensor.x[..., some].ravel().tolist()
    counted = {"receiver eve trace", "link eve lost", "link eve unsent"}
    for name, numbers in entries(all_of).items():
        assert (of_some[name] == numbers) is (name in counted)
        assert name in counted or 3 * len(of_some[name]) == 2 * len(numbers)


def test_a_copy_shares_no_memory() -> None:
    """Not even with the larger arrays that its own are parts of."""
    part_of = part(whole(), slice(0, 1))
    assert entries(part_of.copied()) == entries(part_of)
    for record in records(part_of.copied()).values():
        assert all(array.base is None for array in record.arrays())
