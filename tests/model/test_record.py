"""Records: what is written once for all of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags
from evedrop.model.record import Record, column, columns, largest_bytes
from evedrop.model.slot.records import ReceiverSlots


@dataclass(frozen=True, eq=False)
class Weather(Record):
    """A record of the tests'."""

    wind: Floats = column("c 2 R", "speed in two directions")
    gauges: Any = column("c", "gauges that were read", "<u4")
    wet: Flags | None = column("c R", "whether it rained; None: nobody looked", "?", default=None)


def weather(first: int = 3, count: int = 4, trials: int = 3, wet: bool = True) -> Weather:
    """Some slots, with different numbers."""
    wind = np.arange(count * 2 * trials, dtype=np.float64).reshape(count, 2, trials)
    return Weather(first, wind, np.arange(count, dtype=np.uint32), wind[:, 0] > 4.0 if wet else None)


def test_columns_are_what_was_declared() -> None:
    """In order, with their axes, types and shapes."""
    wind, gauges, wet = columns(Weather)
    assert [entry.name for entry in (wind, gauges, wet)] == ["wind", "gauges", "wet"]
    assert (wind.optional, wet.optional, wet.is_flag, gauges.is_flag) == (False, True, True, False)
    assert (wind.shape({"R": 7}), wet.shape({"R": 7}), gauges.shape({"R": 7})) == ((2, 7), (7,), ())
    assert (wind.slot_bytes({"R": 9}), wet.slot_bytes({"R": 9}), gauges.slot_bytes({"R": 9})) == (144, 2, 4)
    bare = largest_bytes(Weather, 0, {"R": 9})
    assert largest_bytes(Weather, 5, {"R": 9}) == bare + 5 * (144 + 2 + 4)
    assert bare > 3


def test_some_slots_and_some_trials_are_views() -> None:
    """Of all columns that are there; those without trials are the same for some of the trials."""
    whole = weather()
    assert (whole.count, whole.slots) == (4, range(3, 7))
    some = whole.rows(slice(1, 3))
    assert (some.slots, some.gauges.tolist()) == (range(4, 6), [1, 2])
    assert some.wind.base is not None
    assert whole.rows(slice(0, 4)) is whole
    assert whole.rows(slice(None, 2)).first == 3
    part = whole.part(slice(1, 3))
    assert part.wet is not None
    assert (part.wind.shape, part.wet.shape, part.gauges.tolist()) == ((4, 2, 2), (4, 2), [0, 1, 2, 3])
    assert weather(wet=False).part(slice(0, 1)).wet is None


def test_slots_are_joined_as_they_were_cut() -> None:
    """A single record is itself; a column that only some have is refused."""
    whole = weather()
    parts = [whole.rows(rows) for rows in (slice(0, 1), slice(1, 3), slice(3, 4))]
    joined = Weather.joined(parts)
    assert joined.slots == whole.slots
    assert all(np.array_equal(*pair) for pair in zip(joined.arrays(), whole.arrays(), strict=True))
    assert Weather.joined([whole]) is whole
    dry = [part.changed(wet=None) for part in parts]
    assert Weather.joined(dry).wet is None
    with pytest.raises(ValueError, match="only some of the slots from 3 on have wet: whether it rained; None: nobody"):
        Weather.joined([parts[0], dry[1]])


def test_a_copy_owns_its_arrays_and_a_change_leaves_the_record_as_it_is() -> None:
    """Records are frozen: a changed one is another."""
    whole = weather()
    assert all(array.base is None for array in whole.rows(slice(0, 2)).copied().arrays())
    later = whole.changed(first=9)
    assert (later.first, whole.first) == (9, 3)
    assert later.wind is whole.wind
    assert isinstance(later, Weather)
    assert {entry.name for entry in fields(later)} == set(vars(later))


def test_a_receiver_has_the_traces_of_all_trials_only_if_all_are_recorded() -> None:
    """Tr P of each, (c, R)."""
    P = np.arange(16.0).reshape(1, 2, 2, 4)
    slots = ReceiverSlots(0, np.zeros((1, 2, 4)), np.zeros((1, 4), np.uint8), P)
    assert slots.traces_of_trials is not None
    assert slots.traces_of_trials.tolist() == [[12.0, 14.0, 16.0, 18.0]]
    assert slots.changed(P=P[..., :2]).traces_of_trials is None
    assert slots.beliefs.P is P
