"""The numbers of messages that arrived: which were lost, came late or twice, and which gaps are not losses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.scenario.recordings.message_recording import MessageArrivals, numbers_of_times, series_of
from tests.scenario.recordings.recorded_messages import BURSTS, heard, lossy, trimmed


@given(
    st.lists(st.integers(0, 1), min_size=2, max_size=60).filter(lambda word: sum(word) > 1),
    st.integers(0, 2**32 - 1) | st.integers(2**32 - 60, 2**32 - 1),
    st.randoms(use_true_random=False),
)
def test_late_and_repeated_messages_are_no_losses(word: list[int], first: int, random: Any) -> None:
    """With any late or repeated messages, and any wrap of the numbers, the outcomes are those of the link."""
    places = [i for i, outcome in enumerate(word) if outcome]
    arrived = places + [place for place in places if random.random() < 0.3]
    arrived.sort(key=lambda place: place + random.random() * 5.0)
    numbers = np.array([(first + place) % 2**32 for place in arrived], np.int64)
    sent = np.array(arrived, np.float64)
    series = series_of(MessageArrivals(numbers, np.arange(len(arrived), dtype=np.float64), sent), wrap=2**32)
    assert series.outcomes.tolist() == trimmed(np.array(word, np.uint8))
    assert series.repeated == len(arrived) - len(places)
    firsts = list(dict.fromkeys(arrived))
    assert series.late == sum(place < max(firsts[: i + 1]) for i, place in enumerate(firsts))
    assert series.parts == 1
    assert series.first_arrivals.sum() == len(places)


@pytest.mark.parametrize("times_known", [True, False])
@pytest.mark.parametrize("before", [200, 40])
def test_a_sender_that_starts_again_loses_nothing(before: int, times_known: bool) -> None:
    """Its numbers go back to 1: two parts, between which nothing is known; a late message is not taken for that."""
    first, second = lossy(BURSTS, before, 3), lossy(BURSTS, 300, 4)
    numbers = [number for number, *_ in [*heard(first), *heard(second)]]
    numbers[10], numbers[11] = numbers[11], numbers[10]
    sent = np.arange(len(numbers), dtype=np.float64)
    sent[10], sent[11] = sent[11], sent[10]
    clock = np.arange(len(numbers), dtype=np.float64)
    series = series_of(MessageArrivals(np.array(numbers), clock, sent if times_known else None), wrap=2**32)
    assert (series.parts, series.restarts, series.late, series.repeated) == (2, 1, 1, 0)
    assert series.outcomes.tolist() == trimmed(first) + trimmed(second)


@pytest.mark.parametrize(("behind", "restarts"), [(50, 0), (80, 1)])
def test_a_number_far_behind_is_a_restart(behind: int, restarts: int) -> None:
    """Without times of sending, even if the number that was due follows: what is 64 numbers behind or less is late."""
    numbers = np.delete(np.arange(300), 200 - behind).tolist()
    numbers.insert(199, 200 - behind)
    series = series_of(MessageArrivals(np.array(numbers), np.arange(300.0)))
    assert (series.restarts, series.late) == (restarts, 1 - restarts)


def test_a_counter_that_leaps_is_no_loss() -> None:
    """100 000 numbers in the time of one message: the counter was set; in the time of as many messages: they were lost."""
    numbers = np.concatenate([np.arange(200), 100_000 + np.arange(200)])
    leapt = series_of(MessageArrivals(numbers, np.arange(400.0)))
    assert (leapt.leaps, leapt.parts, leapt.outcomes.tolist()) == (1, 2, [1] * 400)
    away = series_of(MessageArrivals(numbers, numbers.astype(np.float64)))
    assert (away.leaps, away.parts, len(away.outcomes), away.outcomes.sum()) == (0, 1, 100_200, 400)


def test_a_long_silence_can_be_left_out() -> None:
    """With a limit, a recorder that paused or a robot that was away for a minute loses no messages; short gaps still do."""
    numbers = np.concatenate([np.arange(0, 100, 2), 700 + np.arange(0, 100, 2)])
    arrivals = MessageArrivals(numbers, numbers / 10.0)
    assert series_of(arrivals).outcomes.sum() == len(numbers)
    series = series_of(arrivals, longest=30.0)
    assert series.outages == pytest.approx((60.2,))
    assert series.outcomes.tolist() == ([1, 0] * 49 + [1]) * 2


@pytest.mark.parametrize(("again", "counts"), [(False, (1, 0)), (True, (0, 1))])
def test_a_late_message_from_before_a_silence_makes_no_losses_of_it(again: bool, counts: tuple[int, int]) -> None:
    """It comes after the silence, alone or for the second time: the messages of the silence are still no losses."""
    numbers = np.concatenate([np.arange(100), 1100 + np.arange(100)])
    order = np.insert(numbers if again else numbers[numbers != 50], 106, 50)
    series = series_of(MessageArrivals(order, np.maximum.accumulate(order / 10.0), order / 10.0), longest=5.0)
    assert (series.outcomes.tolist(), series.parts) == ([1] * 200, 2)
    assert (series.late, series.repeated) == counts


def test_too_many_outcomes_are_refused() -> None:
    """They are refused before memory is allocated for them."""
    arrivals = MessageArrivals(np.array([0, 1, 10**9]), np.array([0.0, 1.0, 1e9]))
    with pytest.raises(ValueError, match="more than 10000000 outcomes"):
        series_of(arrivals)


def test_regular_messages_are_numbered_by_their_times() -> None:
    """Up to a quarter of a period of jitter; messages further away are counted."""
    random = np.random.default_rng(5)
    kept = np.flatnonzero(lossy(BURSTS, 2000))
    numbers, off = numbers_of_times(kept * 0.1 + random.uniform(-0.01, 0.01, len(kept)), 0.1)
    assert numbers.tolist() == (kept - kept[0]).tolist()
    assert off == 0.0
    assert numbers_of_times(np.sort(random.uniform(0.0, 200.0, 2000)), 0.1)[1] > 0.3


def test_a_message_that_was_sent_late_is_no_loss() -> None:
    """Late by more than half a period, or with the ones after it; what is lost before and after still is."""
    kept = np.delete(np.arange(2000), [100, 500, 501, 1500])
    times = np.array(kept * 0.1, np.float64)
    times[[300, 900]] += 0.06
    times[1200:1204] = times[1204] - [0.012, 0.009, 0.006, 0.003]
    numbers, off = numbers_of_times(times, 0.1)
    assert numbers.tolist() == kept.tolist()
    assert 0.0 < off < 0.01
