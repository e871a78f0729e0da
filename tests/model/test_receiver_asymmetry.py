"""Covariances are symmetric except for rounding: what is more is found, and what is less is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.kernels import reference
from evedrop.model.receiver import Action, asymmetry, trace_of
from tests.builders import mirrored
from tests.examples import examples


@settings(max_examples=examples(40), deadline=None)
@given(
    st.integers(0, 2**32),
    st.sampled_from([1, 2, 3, 8, 30]),
    st.sampled_from([0.1, 0.9, 1.0, 1.4]),
    st.floats(0.0, 1.0),
)
def test_beliefs_of_any_process_are_symmetric(seed: int, n: int, radius: float, decoded: float) -> None:
    """Of states with any units, for contracting and growing processes, and whatever the receiver does with its packets."""
    random = np.random.default_rng(seed)
    A, B = random.standard_normal((n, n)), random.standard_normal((n, n))
    units = 10.0 ** random.integers(-6, 7, n)
    A = A * radius / max(abs(np.linalg.eigvals(A))) * units[:, None] / units
    Q = mirrored((units[:, None] * units * (B @ B.T + np.eye(n)))[:, :, None])[:, :, 0]
    actions = np.where(random.random((100, 4)) < decoded, Action.INNOVATION, Action.LOST).astype(np.uint8)
    actions[random.random(actions.shape) < 0.01] = Action.STATE
    P = reference.follow_covariance(A, Q, np.repeat(Q[:, :, None], 4, axis=2), actions)
    assert asymmetry(P) is None


def test_numbers_near_the_smallest_double_are_symmetric() -> None:
    """A receiver that decodes all innovations of a contracting process reports less and less, and 0 at last."""
    A, Q = np.array([[0.3, 0.2], [-0.1, 0.4]]), np.array([[1.0, 0.3], [0.3, 2.0]])
    P = reference.follow_covariance(A, Q, Q[:, :, None], np.full((500, 1), Action.INNOVATION, np.uint8))
    assert 0.0 < P[330:, 0, 0].max() < 1e-250
    assert not P[-1].any()
    assert asymmetry(P) is None


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e300])
def test_the_first_place_that_is_asymmetric_is_found(scale: float) -> None:
    """By slot, row, column and trial, for small and large numbers alike; without a slot it is the same."""
    P = np.repeat(np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]])[None, :, :, None] * scale, 3, axis=0)
    P = np.repeat(P, 2, axis=3)
    assert asymmetry(P) is None
    P[1, 1, 0, 1] *= 1.0 + 1e-12
    assert asymmetry(P) is None
    P[2, 2, 1, 1] = 1e-5 * scale
    assert asymmetry(P) == (2, 1, 2, 1)
    assert asymmetry(P[2]) == (1, 2, 1)
    assert asymmetry(P[1]) is None


def test_made_up_numbers_are_judged() -> None:
    """Differences beyond the range of doubles, and diagonals that no covariance has."""
    assert asymmetry(np.array([[[0.0], [1e308]], [[-1e308], [0.0]]])) == (0, 1, 0)
    assert asymmetry(np.array([[[-1.0], [2.0]], [[2.0], [-1.0]]])) is None
    assert asymmetry(np.array([[[-1.0], [2.0]], [[3.0], [-1.0]]])) == (0, 1, 0)


def test_traces_of_trials() -> None:
    """The sum of each trial's diagonal, in the order of its entries."""
    P = np.random.default_rng(3).standard_normal((3, 3, 5))
    assert np.array_equal(trace_of(P), [P[0, 0, r] + P[1, 1, r] + P[2, 2, r] for r in range(5)])
