"""Messages counted in steps of time: no message is lost or counted twice, and work and memory are bounded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evedrop.wire.records import RECORD, UNLINKED, WireFate
from evedrop.wire.time_steps import DELIVERED, OUTCOMES, StepCounter, WireSteps, quantile
from tests.examples import examples
from tests.wire.wire_rows import START, robot_plan, traffic

STEP = 0.1


def counted(blocks: list[NDArray[Any]], links: int = 3) -> list[WireSteps]:
    """The steps of some blocks, all closed."""
    counter = StepCounter(links, STEP, START)
    return [*(steps for block in blocks for steps in counter.add(block)), *counter.finish()]


def test_steps_hold_the_messages_of_their_time() -> None:
    """Each step has, for each link and outcome, the messages with times in it, however the rows come in blocks."""
    rows = traffic(robot_plan(), 20.0, {"scan": 200.0, "command": 20.0, "listener": 50.0}, (5.0, 7.0))
    for pieces in (1, 7, 300):
        steps = counted(np.array_split(rows, pieces))
        counts = np.concatenate([step.counts for step in steps])
        assert [step.first for step in steps] == np.cumsum([0, *(len(step.counts) for step in steps)])[:-1].tolist()
        assert len(counts) == 200
        for link in range(3):
            for at, fate in enumerate(OUTCOMES):
                of = rows[(rows["link"] == link) & (rows["fate"] == fate)]["time"] - START
                expected = np.histogram(of, np.arange(201) * STEP)[0]
                np.testing.assert_array_equal(counts[:, link, at], expected)


rows_of_any_time = st.lists(
    st.tuples(
        st.floats(-5.0, 1e5, allow_nan=False),
        st.sampled_from([0, 1, 2, UNLINKED]),
        st.sampled_from([int(fate) for fate in WireFate]),
    ),
    max_size=60,
)


@settings(deadline=None, max_examples=examples(40))
@given(st.lists(rows_of_any_time, max_size=4))
def test_every_message_is_counted_once(block_: list[list[tuple[float, int, int]]]) -> None:
    """For any times, also before the start, long after it and out of order; steps do not overlap, and they are few."""
    blocks = []
    for messages_ in block_:
        block = np.zeros(len(messages_), RECORD)
        for at, (seconds, link, fate) in enumerate(messages_):
            block[at]["time"], block[at]["link"], block[at]["fate"] = START + seconds, link, fate
        blocks.append(block)
    steps = counted(blocks)
    messages = sum(len(block) for block in blocks)
    assert sum(int(step.counts.sum()) for step in steps) == messages
    for link in range(4):
        for at, fate in enumerate(OUTCOMES):
            of = sum(
                int(np.sum((b["link"] == (UNLINKED if link == 3 else link)) & (b["fate"] == fate))) for b in blocks
            )
            assert sum(int(step.counts[:, link, at].sum()) for step in steps) == of
    ends = [step.first + len(step.counts) for step in steps]
    assert all(step.first >= end for step, end in zip(steps[1:], ends[:-1], strict=True))
    assert sum(len(step.counts) for step in steps) <= 64 * (2 * messages + 3)


def test_a_silence_takes_little() -> None:
    """After ten days without a message, a few steps are given, the last of them just before the next message."""
    rows = np.zeros(2, RECORD)
    rows["time"] = START, START + 864_000.0
    steps = counted([rows])
    assert sum(len(step.counts) for step in steps) < 200
    assert [int(step.counts.sum()) for step in steps][-1] == 1
    assert steps[-1].first == 8_639_999


@pytest.mark.parametrize("fraction", [0.5, 0.99])
def test_quantiles_of_delays_are_right_within_three_per_cent(fraction: float) -> None:
    """Over all orders of magnitude; a delay of 0 is 0, and no delivered message gives NaN."""
    rng = np.random.default_rng(5)
    rows = np.zeros(20_000, RECORD)
    rows["time"], rows["link"] = START, np.repeat(np.arange(4), 5000)
    rows["delay"] = 10.0 ** rng.uniform(-4.5, 2.5, 20_000)
    rows["delay"][rows["link"] == 1] = 0.0
    rows["fate"][rows["link"] == 2] = WireFate.LOST
    rows["delay"][rows["link"] == 3] = rng.normal(0.02, 0.005, 5000)
    first = counted([rows], 4)[0]
    shown = quantile(first.delays[0], first.middles, fraction)
    assert shown[1] == 0.0
    assert np.isnan(shown[[2, 4]]).all()
    for link in (0, 3):
        expected = np.quantile(rows["delay"][rows["link"] == link], fraction)
        np.testing.assert_allclose(shown[link], expected, rtol=0.04)


def test_a_constant_delay_is_shown_as_it_is() -> None:
    """80 ms and no other number: a bucket stands for the delays that are in it."""
    rows = np.zeros(100, RECORD)
    rows["time"], rows["delay"] = START, 0.08
    first = counted([rows], 1)[0]
    assert quantile(first.delays, first.middles, 0.5)[0, 0] == 0.08
    assert quantile(first.delays, first.middles, 0.99)[0, 0] == 0.08


def test_a_fate_may_change_afterwards() -> None:
    """The message counts for its new fate, whether its step is open or not."""
    rows = traffic(robot_plan(), 1.0, {"scan": 100.0})
    row = rows[(rows["fate"] == WireFate.DELIVERED) & (rows["time"] > START + 2.5 * STEP)][:1]
    for closed in (False, True):
        counter = StepCounter(3, STEP, START)
        steps = [*counter.add(rows)]
        steps += [*counter.close(START + 0.5)] if closed else []
        counter.amend(row, WireFate.UNDERWAY)
        steps += [*counter.finish()]
        counts = np.concatenate([step.counts for step in steps])
        total, of_new = counts.sum((0, 1)), counts[:, 0, OUTCOMES.index(WireFate.UNDERWAY)]
        own = int((row["time"][0] - START) / STEP)
        assert np.flatnonzero(of_new).tolist() == [5 if closed else own]
        assert total[OUTCOMES.index(WireFate.UNDERWAY)] == 1
        assert total[DELIVERED] == int(np.sum(rows["fate"] == WireFate.DELIVERED)) - 1
