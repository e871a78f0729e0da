"""Recorded losses: by the slot, once or round and round, from one beginning or from many; and how rates scatter."""

from __future__ import annotations

from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evedrop.model.links import loss_of
from evedrop.model.links.chain import count_variance
from evedrop.model.links.loss_model import Fate
from evedrop.model.links.markov import stationary
from evedrop.model.links.trace import MOST_OUTCOMES, RecordedLoss
from evedrop.model.process import Floats
from evedrop.model.streams import Stream, root_of_seed, stream_key, uniforms

KEY = stream_key(root_of_seed(5), "link/eve")


def delivered(spec: dict[str, Any], slots: range, trials: int = 3) -> NDArray[np.bool_]:
    """What a fresh model delivers in these slots, (slots, trials)."""
    model = loss_of(spec)
    drawn = uniforms(Stream(KEY, range(trials), model.uniforms_per_slot).words(slots)).transpose(0, 2, 1)
    delivered_: NDArray[np.bool_] = model.fates(slots.start, drawn) == Fate.DELIVERED
    return delivered_


def test_a_looped_trace_begins_again() -> None:
    """Slot k has the outcome at place k, counted round and round, in every trial."""
    result = delivered({"model": "trace", "outcomes": "11010"}, range(12))
    assert result.T.tolist() == [[c == "1" for c in "110101101011"]] * 3
    assert loss_of({"model": "trace", "outcomes": "11010"}).quality == pytest.approx(0.6)


def test_a_trace_is_read_once_up_to_its_end() -> None:
    """Every outcome but no more: the slot after the last one is an error."""
    spec = {"model": "trace", "outcomes": "11010", "once": True}
    assert delivered(spec, range(5), 1)[:, 0].tolist() == [True, True, False, True, False]
    with pytest.raises(ValueError, match="has 5 outcomes and slot 5 was asked for"):
        delivered(spec, range(6))


@settings(deadline=None)
@given(st.text("01", min_size=1, max_size=40), st.integers(1, 90), st.integers(0, 2**40))
def test_a_random_start_is_the_first_uniforms_place(outcomes: str, slots: int, first: int) -> None:
    """Trial r reads on round the recording from ⌊u · length⌋, u its uniform of the first slot asked for."""
    spec = {"model": "trace", "outcomes": outcomes, "random_start": True}
    result = delivered(spec, range(first, first + slots), 4)
    u = uniforms(Stream(KEY, range(4), 1).words(range(first, first + 1)))[0, :, 0]
    for r in range(4):
        begin = int(u[r] * len(outcomes))
        expected = [outcomes[(begin + first + k) % len(outcomes)] == "1" for k in range(slots)]
        assert result[:, r].tolist() == expected


def test_random_starts_are_everywhere() -> None:
    """A million trials begin at each of eight places about equally often: chi-square below its 1e-6 quantile, 40.5."""
    length, trials = 8, 1_000_000
    u = uniforms(Stream(KEY, range(trials), 1).words(range(1)))[:, :, 0]
    model = RecordedLoss("10000000", random_start=True)
    hits = np.zeros(length)
    for k in range(length):
        hits[(length - k) % length] = (model.fates(k, u[:, None, :]) == Fate.DELIVERED).sum()
    assert hits.sum() == trials
    assert ((hits - trials / length) ** 2 / (trials / length)).sum() < 40.5


@pytest.mark.parametrize("window", [1, 3, 7, 9, 30])
def test_the_rate_of_a_random_start_scatters_as_windows_do(window: int) -> None:
    """Variance over trials: that over all places where a window can lie, round and round."""
    outcomes = "1101001110"
    trace = RecordedLoss(outcomes, random_start=True)
    ring = [int(c) for c in outcomes] * 5
    rates = [sum(ring[begin : begin + window]) / window for begin in range(len(outcomes))]
    assert trace.rate_variance(range(4, 4 + window)) == pytest.approx(float(np.var(rates)), abs=1e-15)
    assert not trace.memoryless
    assert trace.quality_at(range(3)).tolist() == pytest.approx([0.6] * 3)


def test_what_is_certain_has_no_variance() -> None:
    """A pattern and a trace with one beginning: quality 0 or 1 in each slot, no trial differs, slots are independent."""
    for model in ("pattern", "trace"):
        loss = loss_of({"model": model, "outcomes": "110"})
        assert loss.quality_at(range(2, 7)).tolist() == [0.0, 1.0, 1.0, 0.0, 1.0]
        assert loss.rate_variance(range(7)) == 0.0
        assert loss.memoryless


def enumerated(T: Floats, distribution: Floats, quality: Floats, slots: int) -> float:
    """Variance of the count delivered in some slots, from every way through the chain."""
    mean = second = 0.0
    for path in product(range(len(distribution)), repeat=slots):
        chance = distribution[path[0]] * np.prod([T[a, b] for a, b in pairwise(path)])
        q = quality[list(path)]
        mean += chance * q.sum()
        second += chance * (q.sum() ** 2 + (q * (1 - q)).sum())
    return float(second - mean**2)


@pytest.mark.parametrize("slots", [1, 2, 3, 5, 8])
@pytest.mark.parametrize(
    ("rows", "quality"),
    [
        ([[0.9, 0.1], [0.4, 0.6]], [0.95, 0.2]),
        ([[0.0, 1.0], [1.0, 0.0]], [1.0, 0.0]),
        ([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.3, 0.0, 0.7]], [1.0, 0.4, 0.1]),
        ([[1.0]], [0.7]),
    ],
)
def test_the_rate_of_a_chain_scatters_as_all_its_paths_do(
    rows: list[list[float]], quality: list[float], slots: int
) -> None:
    """Exact for every number of slots, a periodic chain and a single state among them."""
    T, q = np.array(rows), np.array(quality)
    distribution = stationary(T)
    assert count_variance(T, distribution, q, slots) == pytest.approx(enumerated(T, distribution, q, slots), abs=1e-13)


def test_the_rate_of_many_slots_has_its_limit() -> None:
    """A Gilbert–Elliott link over 10⁸ slots: π_g π_b (1 + λ)/(1 − λ) a slot, λ = 1 − p − r."""
    p, r, slots = 0.01, 0.09, 100_000_000
    loss = loss_of({"model": "gilbert-elliott", "p": p, "r": r})
    limit = p * r / (p + r) ** 2 * (2 - p - r) / (p + r) / slots
    assert loss.rate_variance(range(slots)) == pytest.approx(limit, rel=1e-5)
    assert loss_of({"model": "bernoulli", "quality": 0.7}).rate_variance(range(50)) == pytest.approx(0.21 / 50)
    assert loss_of({"model": "bernoulli", "quality": 0.7}).memoryless
    assert not loss.memoryless
    assert loss.quality_at(range(5, 7)).tolist() == pytest.approx([0.9, 0.9])


@pytest.mark.parametrize(
    ("given", "entry", "message"),
    [
        ({"outcomes": "12"}, "outcomes", 'is "12"; expected a word of 0 (lost) and 1 (delivered)'),
        ({"outcomes": ""}, "outcomes", 'is ""; expected a word'),
        ({"outcomes": "1" * (MOST_OUTCOMES + 1)}, "outcomes", "are 10000001; expected at most 10000000"),
        ({"outcomes": "1", "once": 1}, "once", "is 1; expected true or false"),
        ({"outcomes": "1", "random_start": "yes"}, "random_start", 'is "yes"; expected true or false'),
        ({"once": True, "random_start": True}, "random_start", "is given together with once"),
    ],
)
def test_a_mistake_of_a_trace_is_named(given: dict[str, Any], entry: str, message: str) -> None:
    """One mistake, at its entry."""
    ((place, sentence),) = RecordedLoss.mistakes(given)
    assert place == entry
    assert message in sentence
