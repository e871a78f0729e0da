"""How well a house's activity is told from guesses of its load, against definitions by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.studies.applications.microgrid.household import active, area, detection_rate, means


def test_a_window_is_active_by_its_mean() -> None:
    """Two whole windows of three slots, and what is left over."""
    load = np.array([0.0, 3.0, 0.0, 0.9, 0.9, 0.9, 5.0])
    assert np.allclose(means(load, 3), [1.0, 0.9])
    assert means(np.stack([load, load], axis=1), 3).shape == (2, 2)
    assert active(load, 3, 1.0).tolist() == [True, False]
    assert active(load, 3, 0.5).tolist() == [True, True]


@pytest.mark.parametrize(
    ("score", "truth", "expected"),
    [
        ([3.0, 4.0, 1.0, 2.0], [1, 1, 0, 0], 1.0),
        ([1.0, 2.0, 3.0, 4.0], [1, 1, 0, 0], 0.0),
        ([7.0, 7.0, 7.0, 7.0], [1, 0, 1, 0], 0.5),
        ([3.0, 1.0, 2.0, 1.0], [1, 1, 0, 0], 0.625),
    ],
)
def test_area_by_hand(score: list[float], truth: list[int], expected: float) -> None:
    """All, none, ties, and a mixture: 3 > 2, 3 > 1, 1 < 2, 1 = 1."""
    assert area(np.array(score), np.array(truth, np.bool_)) == expected


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=2, max_size=30))
def test_area_is_the_chance_to_be_right_about_a_pair(windows: list[tuple[int, bool]]) -> None:
    """Over all pairs of an active and a quiet window, ties counted half."""
    score = np.array([score_ for score_, _ in windows], np.float64)
    truth = np.array([pair for _, pair in windows])
    pairs = [(a > b) + 0.5 * (a == b) for a in score[truth] for b in score[~truth]]
    result = area(score, truth)
    assert np.isclose(result, np.mean(pairs)) if pairs else np.isnan(result)


def test_detection_at_a_rate_of_false_alarms() -> None:
    """Of 40 quiet windows two may be taken for active; ties at the threshold are decided by a coin."""
    off = np.arange(40.0)
    on = np.array([100.0, 37.5, 38.0, 3.0])
    score, truth = np.concatenate([off, on]), np.arange(44) >= 40
    # The threshold is 37: above it are 38 and 39 alone.
    assert detection_rate(score, truth, 0.05) == 0.75
    assert detection_rate(score, truth, 0.0) == 0.25
    assert detection_rate(score, truth, 1.0) == 1.0
    assert np.isclose(detection_rate(np.zeros(44), truth, 0.05), 0.05)


def test_who_knows_nothing_is_a_coin() -> None:
    """Scores that have nothing to do with the truth: ½; found as often as falsely alarmed, within four standard deviations."""
    rng = np.random.default_rng(1)
    score, truth = rng.standard_normal(20_000), rng.random(20_000) < 0.2
    assert abs(area(score, truth) - 0.5) < 4 * (1 / (12 * 4000)) ** 0.5
    assert abs(detection_rate(score, truth, 0.05) - 0.05) < 4 * (0.05 / 4000) ** 0.5 + 0.01


def test_with_one_kind_of_window_there_is_nothing_to_tell() -> None:
    """A house that is never active, or always."""
    for truth in (np.zeros(4, np.bool_), np.ones(4, np.bool_)):
        assert np.isnan(area(np.arange(4.0), truth))
        assert np.isnan(detection_rate(np.arange(4.0), truth, 0.05))
