"""The effect of a slot on covariances and errors, against the table of `evedrop.model.update`."""

from __future__ import annotations

import numpy as np

from evedrop.model import update
from evedrop.model.receiver import Action, Belief
from tests.builders import UNSTABLE

ACTIONS = np.array([Action.LOST, Action.DISCARDED, Action.STATE, Action.STATE, Action.INNOVATION], np.uint8)
INNOVATIONS = np.array([False, True, False, True, True])
"""ν of the five trials: the fourth is misled."""


def test_the_error_of_a_slot_is_the_tables() -> None:
    """A e + w without a packet, 0 with the state, A x − χ if misled, A e with a decoded innovation."""
    rng = np.random.default_rng(3)
    e, w, misled = (rng.normal(size=(2, 5)) for _ in range(3))
    carried = UNSTABLE.A @ e
    error = update.error(UNSTABLE, e, ACTIONS, INNOVATIONS, w, lambda: misled)
    expected = np.stack(
        [carried[:, 0] + w[:, 0], carried[:, 1] + w[:, 1], np.zeros(2), misled[:, 3], carried[:, 4]], axis=1
    )
    assert np.allclose(error, expected, rtol=1e-14)


def test_the_actual_covariance_of_a_slot_is_the_tables() -> None:
    """As the receiver reports, but where it was misled, f_k."""
    half = np.random.default_rng(4).normal(size=(2, 2, 5))
    P = np.einsum("ijr,kjr->ikr", half, half)
    f = np.array([[3.0, 1.0], [1.0, 2.0]])
    A, Q = UNSTABLE.A, UNSTABLE.Q
    carried = np.einsum("ij,jkr,lk->ilr", A, P, A)
    expected = np.stack([carried[..., 0] + Q, carried[..., 1] + Q, np.zeros((2, 2)), f, carried[..., 4]], axis=-1)
    assert np.allclose(update.actual_covariance(UNSTABLE, 1, P, ACTIONS, INNOVATIONS, f), expected, rtol=1e-12)
    expected[..., 3] = 0.0
    assert np.allclose(update.reported_covariance(UNSTABLE, 1, P, ACTIONS), expected, rtol=1e-12)
    before = update.reported_covariance(UNSTABLE, 0, P, ACTIONS)
    assert np.array_equal(before, np.where(ACTIONS == Action.STATE, 0.0, P)), "slot 0 is not predicted"


def test_the_estimate_of_a_slot_is_the_tables() -> None:
    """A x̂ without a packet, z as the state, A x̂ + z − χ where an innovation is decoded; slot 0 is not predicted."""
    rng = np.random.default_rng(5)
    x_hat, z, chi = (rng.normal(size=(2, 5)) for _ in range(3))
    given_belief = Belief(x_hat, np.zeros((2, 2, 5)), ACTIONS)
    for k, before in ((1, UNSTABLE.A @ x_hat), (0, x_hat)):
        expected = np.where(ACTIONS == Action.STATE, z, before)
        belief = update.belief(UNSTABLE, k, given_belief, ACTIONS, z, chi)
        decoded = np.where(ACTIONS == Action.INNOVATION, before + (z - chi), expected)
        assert np.allclose(belief.x_hat, decoded, rtol=1e-14)
