"""A link whose schedule is changed while it runs decides as if all changes had been known before."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.slot.link import Change, Fates, Link, LinkSchedule, streams_of
from evedrop.model.streams import Batch

BURSTS = {"model": "gilbert-elliott", "p": 0.2, "r": 0.4}
COINS = {"model": "bernoulli", "quality": 0.6}
DELAYED = {
    "loss": BURSTS,
    "delay": {"model": "normal", "mean": 1.5, "standard_deviation": 1.0},
    "reorder": 0.2,
    "duplicate": 0.3,
}
SLOTS, BATCH = 48, 8
Changes = tuple[Change, ...]


def link(*changes: Change) -> Link:
    """A link in bursts with some changes known."""
    schedule = LinkSchedule({"loss": BURSTS}, window=3, changes=changes)
    keys = {name: bytes(31) + bytes([i]) for i, name in enumerate(streams_of("it", schedule))}
    return Link(schedule, "it", keys, Batch(SLOTS, 4))


def steered(planned_changes: Changes, orders: dict[int, list[Changes]]) -> list[Fates]:
    """The fates of all slots, planned in batches; orders: slot → what is due from it on, each time that it is changed."""
    channel, parts = link(*planned_changes), []
    for first in range(0, SLOTS, BATCH):
        start, fates = first, channel.planned(range(first, first + BATCH))
        for k in range(first, first + BATCH):
            for changes in orders.get(k, []):
                parts.append(fates.part(slice(0, k - start)))
                start, fates = k, channel.amended(k, changes)
        parts.append(fates)
    return parts


def columns(parts: list[Fates]) -> list[np.ndarray]:
    """Codes, delays and second copies of all slots, nothing as 0."""
    filled = [
        [np.zeros(part.codes.shape, np.uint32) if column is None else column.astype(np.uint32) for column in part[:3]]
        for part in parts
    ]
    return [np.concatenate(column) for column in zip(*filled, strict=True)]


@pytest.mark.parametrize("k", [0, 7, 8, 19, SLOTS - 1])
def test_an_amended_link_is_one_that_knew(k: int) -> None:
    """Changes at any slot of a batch, several at one, and a later one that is replaced: the same fates as all at once."""
    settings = ({"loss": COINS}, {"loss": BURSTS}, DELAYED)
    changes = (Change(5, {"loss": COINS}), Change(20, {"loss": BURSTS}), Change(30, cut=True), Change(33, cut=False))
    kept = tuple(change for change in changes if change.at >= k)
    later = tuple(Change(change.at, DELAYED if change.settings else None, change.cut) for change in kept)
    first, second = (*kept, Change(k, settings[0])), (Change(k, settings[0]), Change(k, settings[1]), *kept)
    last = (Change(k, settings[0]), Change(k, settings[1]), Change(k, settings[2]), *later)
    result = steered(changes, {k: [first, second, last]})
    at_once = link(*(change for change in changes if change.at < k), *last)
    for mine, theirs in zip(columns(result), columns([at_once.fates(range(SLOTS))]), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_only_slots_that_are_planned_can_be_amended() -> None:
    """Slots that are decided for good, or not decided yet, are refused."""
    channel = link()
    with pytest.raises(ValueError, match="slot 3 is not among those last planned"):
        channel.amended(3, ())
    channel.planned(range(8))
    with pytest.raises(ValueError, match="slot 8 is not among those last planned"):
        channel.amended(8, ())
