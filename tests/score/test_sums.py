"""Quantiles from histograms that add up, against the exact ones."""

from __future__ import annotations

import math
import pickle
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.process import Floats
from evedrop.score.sums import LEVELS, SlotHistograms, quantile_of
from tests.examples import examples

SCALE = 2e-3
QUARTER_OCTAVE = 1.25
"""A bin's ends are at most this far apart."""

values = st.floats(SCALE * 2.0**-23, SCALE * 2.0**100)


def histograms(samples: Floats, first: int = 0, slots: int | None = None) -> SlotHistograms:
    """Of samples (c, R) in slots from `first` on."""
    made = SlotHistograms(first + len(samples) if slots is None else slots, SCALE)
    made.add_values(first, samples)
    return made


def order_statistics(samples: Floats, level: float) -> set[float]:
    """The sample that a quantile is, or the two it may be where rounding decides."""
    ordered, at = np.sort(samples), level * len(samples)
    ranks = {max(1, math.ceil(at - 1e-9)), min(len(samples), math.floor(at + 1e-9) + 1)}
    return {float(ordered[rank - 1]) for rank in ranks}


@given(st.lists(values, min_size=1, max_size=300))
@settings(deadline=None, max_examples=examples(200))
def test_a_quantile_is_within_a_quarter_octave_of_the_exact_one(samples: list[float]) -> None:
    """For any sample and each level, the order statistic and what is reported are less than 25 % apart."""
    exact = np.array(samples)
    (quantiles,) = histograms(exact[None, :]).quantiles()
    for level, value in zip(LEVELS, quantiles, strict=True):
        close = (bound / QUARTER_OCTAVE <= value <= bound * QUARTER_OCTAVE for bound in order_statistics(exact, level))
        assert any(close), (level, value)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_quantiles_of_many_trials_are_close(seed: int) -> None:
    """Interpolated, the quantiles of 20 000 squared normals are within 4 % of numpy's."""
    samples = np.random.default_rng(seed).standard_normal((3, 20_000)) ** 2 * 1e-3
    quantiles = histograms(samples).quantiles()
    assert quantiles == pytest.approx(np.quantile(samples, LEVELS, axis=1).T, rel=0.04)


def test_zero_and_infinity_have_their_places() -> None:
    """Zeros are below every other value, infinities above; neither moves the median of the rest far."""
    samples = np.array([[0.0] * 10 + [SCALE] * 80 + [np.inf] * 10])
    low, middle, high = histograms(samples).quantiles()[0]
    assert 0.0 <= low <= SCALE * 2.0**-23
    assert middle == pytest.approx(SCALE, rel=0.25)
    assert high > SCALE * 2.0**100
    assert histograms(np.zeros((1, 7))).quantiles()[0].max() <= SCALE * 2.0**-23


def test_slots_without_values_have_no_quantiles() -> None:
    """Slots that no trial reached are NaN, and so are those left out of a long run."""
    quantiles = histograms(np.full((2, 5), SCALE), first=1, slots=5).quantiles()
    assert np.isnan(quantiles[[0, 3, 4]]).all()
    assert np.isfinite(quantiles[[1, 2]]).all()


@given(st.integers(4097, 30_000), st.lists(st.integers(1, 700), min_size=1, max_size=80))
@settings(deadline=None, max_examples=examples(25))
def test_a_long_run_is_looked_at_in_even_steps(slots: int, lengths: list[int]) -> None:
    """Every stride-th slot has its own quantiles whatever the chunks it came in, at most 4096 of them."""
    made = SlotHistograms(slots, SCALE)
    end = min(sum(lengths), slots)
    numbers = SCALE * 2.0 ** np.arange(end)[:, None].clip(max=90) * np.ones((1, 3))
    first = 0
    for length in lengths:
        made.add_values(first, numbers[first : first + length])
        first = min(first + length, end)
    stride = -(-slots // 4096)
    quantiles = made.quantiles()
    assert len(quantiles) == slots
    there = np.flatnonzero(np.isfinite(quantiles[:, 1]))
    assert there.tolist() == list(range(0, end, stride))
    assert len(there) <= 4096
    assert quantiles[there, 1] == pytest.approx(numbers[there, 0], rel=0.25)


@given(st.lists(st.lists(values, min_size=1, max_size=20), min_size=2, max_size=6), st.randoms())
@settings(deadline=None, max_examples=examples(50))
def test_merging_is_the_same_in_any_order(parts: list[list[float]], random: Random) -> None:
    """Parts merged in any order and grouping are the histogram of all samples at once."""
    whole = histograms(np.concatenate([np.array(part) for part in parts])[None, :]).quantiles()
    made = [histograms(np.array(part)[None, :]) for part in parts]
    random.shuffle(made)
    while len(made) > 1:
        last = made.pop()
        made[random.randrange(len(made))].merge(last)
    assert np.array_equal(made[0].quantiles(), whole)


def test_what_is_sent_is_small_and_adds_up_as_before() -> None:
    """A worker's histograms of thousands of slots travel without their empty bins, and can be merged and added to."""
    samples = np.random.default_rng(1).exponential(SCALE, (6000, 50))
    made = histograms(samples)
    sent = pickle.dumps(made)
    assert len(sent) < 8 * samples.size + 10_000 < made.counts.nbytes
    arrived = pickle.loads(sent)  # noqa: S301 - our own
    assert np.array_equal(arrived.quantiles(), made.quantiles(), equal_nan=True)
    for histogram in (arrived, made):
        histogram.add_values(0, samples[:, :7])
        histogram.merge(histograms(samples))
    assert np.array_equal(arrived.counts, made.counts)


def test_beyond_the_bins_only_the_side_is_known() -> None:
    """A value too large for the bins is infinite, one too small is 0: never a wrong number."""
    histograms = SlotHistograms(2, 1.0)
    histograms.add_values(0, np.array([[1e80, 1e90, 1e85], [1e-30, 0.0, 1e-25]]))
    quantiles = histograms.quantiles()
    assert np.isinf(quantiles[0]).all()
    assert (quantiles[1] == 0.0).all()


def test_a_quantile_among_infinite_values_is_infinite() -> None:
    """It is no number only where a value is none; below the infinite ones it is that of finite values."""
    some = np.array([1.0, math.inf, 2.0, math.inf])
    assert [quantile_of(some, level) for level in (0.0, 0.25, 0.5, 0.95)] == [1.0, 1.75, math.inf, math.inf]
    assert quantile_of(np.full(4, math.inf), 0.5) == math.inf
    assert quantile_of(np.array([1.0, 2.0, math.inf]), 0.5) == 2.0
    assert quantile_of(np.array([1.0, 2.0, 5.0]), 0.75) == 3.5
