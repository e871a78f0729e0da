"""Consecutive slots joined into one, with every entry of every part."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.score.slots import InputSlots, ReceiverSlots, Slots, concatenated

SHAPES = {"x_hat": (6, 2, 3), "P": (6, 2, 2, 3), "trace": (6, 2), "unsent": (6,), "true": (6, 2, 3), "x": (6, 2, 3)}


def of_shape(name: str) -> Any:
    """Different numbers for every entry; most entries have a row for each slot and a column for each trial."""
    return np.random.default_rng(len(name)).random(SHAPES.get(name, (6, 3)))


def whole() -> Slots:
    """Six slots with every entry that slots can have."""
    plain = {field.name: of_shape(field.name) for field in fields(ReceiverSlots) if field.name != "lost"}
    receivers = {
        "eve": ReceiverSlots(
            **plain, lost={"lost": np.arange(6, dtype=np.uint32), "cut": np.arange(7, 13, dtype=np.uint32)}
        )
    }
    inputs = InputSlots(of_shape("x"), of_shape("failed"), MonitoredSlots(of_shape("statistic"), of_shape("x")))
    return Slots(
        4, of_shape("x"), of_shape("nu"), receivers, of_shape("sent"), of_shape("alarms"), inputs, of_shape("true")
    )


def part(value: Any, rows: slice) -> Any:
    """Some of the slots."""
    if isinstance(value, np.ndarray):
        return value[rows]
    if isinstance(value, dict):
        return {name: part(item, rows) for name, item in value.items()}
    if isinstance(value, int):
        return value + rows.start
    return type(value)(**{field.name: part(getattr(value, field.name), rows) for field in fields(value)})


def entries(value: Any, path: str = "") -> dict[str, list[float]]:
    """Path of every entry → its numbers."""
    if isinstance(value, np.ndarray):
        return {path: value.ravel().tolist()}
    if not isinstance(value, dict):
        value = (
            {"first": [value]}
            if isinstance(value, int)
            else {field.name: getattr(value, field.name) for field in fields(value)}
        )
    result: dict[str, list[float]] = {}
    for name, item in value.items():
        result |= {f"{path}.{name}": item} if isinstance(item, list) else entries(item, f"{path}.{name}")
    return result


def test_every_entry_is_kept() -> None:
    """Slots that were cut into pieces are the same again when they are joined."""
    of_parts = [part(whole(), rows) for rows in (slice(0, 1), slice(1, 5), slice(5, 6))]
    assert len(entries(whole())) == 21
    assert entries(concatenated(of_parts)) == entries(whole())


@pytest.mark.parametrize("name", ["sent", "alarms", "inputs", "true"])
def test_an_entry_that_only_some_parts_have_is_refused(name: str) -> None:
    """It cannot be joined, and is not left out silently."""
    first, second = (part(whole(), rows) for rows in (slice(0, 3), slice(3, 6)))
    with pytest.raises(ValueError, match="some of the parts have an entry that others lack"):
        concatenated([first, replace(second, **{name: None})])
    assert getattr(concatenated([replace(slots, **{name: None}) for slots in (first, second)]), name) is None


def test_a_part_of_the_trials_has_their_columns() -> None:
    """Of every entry that has trials; what is counted over trials stays."""
    some = slice(1, 3)
    result, all_of = entries(whole().part(some)), whole()
    assert result[".x"] == all_of.x[..., some].ravel().tolist()
    assert all_of.inputs is not None
    assert result[".inputs.failed"] == all_of.inputs.failed[..., some].ravel().tolist()
    counted = {
        ".first.first",
        ".receivers.eve.trace",
        ".receivers.eve.unsent",
        ".receivers.eve.lost.lost",
        ".receivers.eve.lost.cut",
    }
    for name, numbers in entries(whole()).items():
        assert (result[name] == numbers) is (name in counted)
        assert name in counted or 3 * len(result[name]) == 2 * len(numbers)


def test_a_copy_shares_no_memory() -> None:
    """Not even with the larger arrays that its own are parts of."""
    part_of = whole().part(slice(0, 1))
    assert entries(part_of.copied()) == entries(part_of)

    def arrays(value: Any) -> list[Any]:
        if isinstance(value, np.ndarray):
            return [value]
        values = value.values() if isinstance(value, dict) else (getattr(value, field.name) for field in fields(value))
        return [array for value in values if not isinstance(value, int) for array in arrays(value)]

    assert all(array.base is None for array in arrays(part_of.copied()))
