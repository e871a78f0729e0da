"""Tallies of a wire: gaps, the numbers on which models decided, quantiles of delays, and the metrics of a link."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.results.wire_summary import WireLinkSummary
from evedrop.wire.records import RECORD, Records, WireFate
from evedrop.wire.tallies import WIRE_METRICS, LinkTally, StreamTally
from tests.examples import examples


def by_hand(rows: list[tuple[float, bool]]) -> tuple[int, float]:
    """The longest run of missing messages, and the longest silence, of (time, delivered)."""
    longest, silence, run, since = 0, 0.0, 0, rows[0][0]
    for at, delivered in rows:
        run = 0 if delivered and not run else run + (not delivered)
        longest = max(longest, run)
        if run:
            silence = max(silence, at - since)
        if delivered:
            run, since = 0, at
    return longest, silence


def check_stream(rows: list[tuple[int, int]], records: Records, sizes: list[int]) -> None:
    """Check a tally against a loop over the messages, of (pause, fate); blocks of these sizes in turn, 0 for one on its own."""
    stream, first, turn = StreamTally(), 0, 0
    while first < len(rows):
        size = sizes[turn % len(sizes)]
        if size:
            stream.add(records[first : first + size], True)
        else:
            time, n, fate = (records[name][first].item() for name in ("time", "n", "fate"))
            stream.add_one(time, n, fate, True)
        first, turn = first + max(size, 1), turn + 1
    pairs = [(float(record["time"]), record["fate"] == 0) for record in records]
    assert (stream.longest, stream.silence) == by_hand(pairs)
    decided = [n for n, (_, fate) in enumerate(rows) if fate in {0, 1}]
    assert [n for start, stop, _ in stream.ranges for n in range(start, stop)] == decided
    assert all(stop - start == count for start, stop, count in stream.ranges)
    assert all(before.stop < after.start for before, after in pairwise(stream.ranges))
    assert (stream.tried, stream.passed) == (len(decided), sum(fate == 0 for _, fate in rows))


@pytest.mark.parametrize("sizes", [[0], [5], [0, 0, 3], [1, 0, 7]])
def test_messages_that_are_added_one_by_one_count_as_those_of_a_block(sizes: list[int]) -> None:
    """A stream may have both, as many messages of its key come at a time."""
    rng = np.random.default_rng(28)
    for fates in ([0], [0] * 30 + [4], [0, 0, 1, 4, 19]):
        rows = [(int(rng.integers(1, 10)), int(rng.choice(fates))) for _ in range(80)]
        records = np.zeros(len(rows), RECORD)
        records["time"], records["fate"] = np.cumsum([pause for pause, _ in rows]), [fate for _, fate in rows]
        records["n"] = np.arange(len(rows))
        check_stream(rows, records, sizes)


@settings(max_examples=examples(60), deadline=None)
@given(
    rows=st.lists(st.tuples(st.integers(1, 9), st.sampled_from([0, 0, 1, 4, 19])), min_size=1, max_size=60),
    size=st.integers(1, 6),
)
def test_gaps_and_numbers_do_not_depend_on_the_blocks(rows: list[tuple[int, int]], size: int) -> None:
    """The longest gap, and the numbers on which the models decided, against a loop over the messages; also one by one."""
    records = np.zeros(len(rows), RECORD)
    records["time"], records["fate"] = np.cumsum([pause for pause, _ in rows]), [fate for _, fate in rows]
    records["n"] = np.arange(len(rows))
    check_stream(rows, records, [size])


@pytest.mark.parametrize("part", [6000, 7])
def test_a_stream_with_many_interruptions_keeps_how_many_of_each_part_of_its_numbers_count(part: int) -> None:
    """Numbers that are too scattered to be kept are counted by cells, no larger than they must be."""
    stream, records = StreamTally(), np.zeros(12_000, RECORD)
    records["n"] = np.arange(12_000)
    records["fate"][3001::2] = WireFate.OVERFLOW
    for first in range(0, len(records), part):
        stream.add(records[first : first + part], True)
    assert stream.scattered
    assert 1024 < len(stream.ranges) < 2048
    assert stream.ranges[0] == (0, 3001, 3001)
    assert all(some.counted == (some.stop - some.start + 1) // 2 <= 4 for some in stream.ranges[1:])
    assert sum(some.counted for some in stream.ranges) == stream.tried == 7500


def test_a_late_number_counts_in_the_range_that_contains_it() -> None:
    """Threads may hand over messages in another order than that of their numbers."""
    stream, records = StreamTally(), np.zeros(2500, RECORD)
    records["n"] = 2 * np.arange(2500)
    stream.add(records, True)
    before = stream.ranges
    stream.add_one(0.0, 1001, 0, True)
    assert stream.ranges == [some._replace(counted=some.counted + (some.start < 1001 < some.stop)) for some in before]


def test_quantiles_of_delays_are_exact_until_there_are_too_many_to_keep() -> None:
    """Then they are those of every second, fourth and so on."""
    tally, records = LinkTally(), np.zeros(100_000, RECORD)
    records["delay"] = np.random.default_rng(5).permutation(np.arange(1, 100_001)) / 1e5
    tally.add(records)
    assert tally.delay_quantile(0.9) == 0.9
    for _ in range(9):
        tally.add(records)
    delay_quantile = tally.delay_quantile(0.9)
    assert delay_quantile is not None
    assert delay_quantile == pytest.approx(0.9, abs=0.005)
    assert LinkTally().delay_quantile(0.5) is None


def test_the_delays_that_are_kept_are_evenly_spaced() -> None:
    """For any sizes of the blocks, and without the messages that were not delivered."""
    tally, rng, count = LinkTally(), np.random.default_rng(5), 1_000_000
    records = np.zeros(count, RECORD)
    records["delay"] = np.arange(count)
    lost = np.zeros(count, RECORD)
    lost["fate"], lost["delay"] = WireFate.LOST, -1.0
    for places in np.split(np.arange(count), np.cumsum(rng.integers(1, 9000, 150))):
        tally.add(np.concatenate([records[places], lost[places]]))
    kept = np.arange(0, count, 8)
    for at in (0, 1, 1000, 30_001, 60_000, len(kept) - 1):
        assert tally.delay_quantile((at + 0.5) / len(kept)) == kept[at]


DELAYS: Any = SimpleNamespace(delay_quantile=lambda quantile: quantile)
"""The tally of messages whose delay has the quantile q at q seconds."""


def link(heard: int) -> WireLinkSummary:
    """A link whose numbers all differ."""
    return WireLinkSummary(
        source="robot",
        target="base",
        keys="**",
        heard=heard,
        bytes=500,
        delivered=3,
        again=2,
        lost_by={},
        dropped_by={},
        rate=None,
        expected_rate=None,
        bounds=None,
        within_bounds=None,
        delays={},
        gap_messages=4,
        gap_seconds=0.7,
    )


@pytest.mark.parametrize(("name", "value"), [("delivery", 0.25), ("gap_messages", 4), ("gap_seconds", 0.7)])
def test_a_metric_is_a_number_of_the_summary(name: str, value: float) -> None:
    """None if the link heard nothing."""
    assert WIRE_METRICS[name].value(link(12), DELAYS, None) == value
    assert WIRE_METRICS[name].value(link(0), DELAYS, None) is None


def test_a_latency_is_the_quantile_that_is_asked_for() -> None:
    """By default the median."""
    assert [WIRE_METRICS["latency"].value(link(12), DELAYS, value) for value in (0.9, None)] == [0.9, 0.5]


def test_what_was_not_delivered_after_all_has_no_delay() -> None:
    """The quantiles are those of the messages that were delivered, however many were kept of all."""
    for count in (10, 400_000):
        tally, records = LinkTally(), np.zeros(count, RECORD)
        records["delay"] = np.random.default_rng(5).permutation(np.arange(count) % 10)
        tally.add(records)
        assert tally.delay_quantile(0.99) == 9.0
        for fate in (WireFate.UNDERWAY, WireFate.CONGESTED):
            tally.amend(records[records["delay"] == (8.0 if fate is WireFate.CONGESTED else 9.0)], fate)
        assert [tally.delay_quantile(level) for level in (0.1, 0.44, 0.98)] == [0.0, 3.0, 7.0]
        tally.amend(records[records["delay"] < 8.0], WireFate.UNDERWAY)
        assert tally.delay_quantile(0.5) is None
