"""Where expected errors grow: the rule against long recursions, in each eigenspace and between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.theory.closed_forms import ClearStatesForm
from evedrop.model.theory.covariances import NOBODY, Outcomes, growth, radius, stability_bound, theoretical_covariances

TURNED, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((4, 4)))
MIXED = Process(TURNED @ np.diag([1.3, 1.1, 1.0, 0.6]) @ TURNED.T, np.eye(4), np.eye(4))
"""A symmetric A, whose eigenvectors are the columns of TURNED."""


@pytest.mark.parametrize(
    ("outcomes", "grows"),
    [
        (Outcomes.legitimate(0.9, 0.9), [False] * 4),
        (Outcomes.legitimate(0.5, 0.6), [True, False, False, False]),
        (Outcomes.eavesdropper(0.3, 0.4, 1.0, 0.0), [True, True, False, False]),
        (Outcomes.eavesdropper(0.9, 0.5, 1.0, 1.0), [True, True, True, False]),
        (Outcomes.genie(0.3, 0.4), [True, True, False, False]),
        (NOBODY, [True, True, True, False]),
        (Outcomes(0.0, state=0.0, misled=0.0, decoded=1.0, initial=1.0), [True, True, False, False]),
        (Outcomes.legitimate(1.0, 0.2), [False] * 4),
        (Outcomes.plain(1.0), [False] * 4),
    ],
)
def test_an_error_grows_where_it_is_kept_longer_than_it_shrinks(outcomes: Outcomes, grows: list[bool]) -> None:
    """By eigenvectors, against the recursion over 3000 slots; a direction between them touches both."""
    result = growth(MIXED, outcomes)
    assert [result.along(v) for v in TURNED.T] == grows
    assert result.along(TURNED[:, 3] + TURNED[:, 0]) is grows[0]
    # Along the axes, where no rounding of a direction that grows gets into another.
    late = theoretical_covariances(replace(MIXED, A=np.diag([1.3, 1.1, 1.0, 0.6])), outcomes, 900)[[300, 899]]
    for i, expected in enumerate(grows):
        before, after = (float(P[i, i]) for P in late)
        assert (after > 1.5 * before) is expected


@pytest.mark.parametrize(
    "A", [[[3.0, -3.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[-3.0, -1.0, -1.5], [6.0, 2.0, 2.5], [8.0, 2.0, 4.0]]]
)
def test_a_triple_root_is_one_root(A: list[list[float]]) -> None:
    """Rounding splits 1 into three roots that are 1e-5 apart, some inside the unit circle; the error grows in all directions."""
    process = Process(np.array(A), np.eye(3), np.eye(3))
    assert radius(process) == 1.0
    assert stability_bound(process, 0.5) == 0.0
    assert growth(process, NOBODY).basis.shape == (3, 3)
    assert growth(process, Outcomes.plain(0.5)).basis.shape == (3, 0)


def test_roots_that_are_near_each_other_are_not_one() -> None:
    """Where nothing moves them: the eigenvalues of a symmetric A."""
    process = Process(np.array([[1.0, 1e-5], [1e-5, 1.0]]), np.eye(2), np.eye(2))
    assert process.spectral_radius == pytest.approx(1.00001, abs=1e-12)
    assert growth(process, NOBODY).basis.shape == (2, 1)


def test_a_direction_is_not_an_eigenvector() -> None:
    """A triangular A: the second state drives the first, so an error of the second direction alone stays bounded."""
    process = Process(np.array([[1.2, 1.0], [0.0, 0.5]]), np.eye(2), np.eye(2))
    result = growth(process, NOBODY)
    assert result.along(np.array([1.0, 0.0])) is True
    assert result.along(np.array([0.0, 1.0])) is False
    turned = Process(process.A.T, np.eye(2), np.eye(2))
    result = growth(turned, NOBODY)
    assert [result.along(v) for v in np.eye(2)] == [True, True]  # the first state drives the second
    # The left eigenvector of 0.5 is orthogonal to the right one of 1.2.
    assert result.along(np.array([-1.0, 0.7])) is False


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_whether_a_state_is_observed_does_not_depend_on_units(unit: float) -> None:
    """A weak coupling in odd units is a strong one in others: the first state shows the second, or it does not."""
    units = np.array([1.0, unit])
    for coupling, seen in ((0.5, True), (0.0, False)):
        A = np.array([[0.9, coupling], [0.0, 1.1]]) * units[:, None] / units
        process = Process(A, np.diag(units**2), np.diag(units**2))
        for mu_d in (0.5, 1.0):
            basis = ClearStatesForm(process, np.array([False, True]), mu_d, 1.0, 10).growing
            assert basis.shape[1] == (0 if seen else 1)
            assert seen or abs(basis[1, 0]) == pytest.approx(1.0)


def test_what_is_not_observed_grows() -> None:
    """Exactly over a perfect link; behind a lossy one only growth, and what the state itself does not do, are certain."""
    process = Process(np.array([[1.1, 0.3, 0.0], [0.0, 1.2, 0.0], [0.0, 0.0, 0.5]]), np.eye(3), np.eye(3))
    hidden = np.array([True, False, True])
    exact, lossy = (ClearStatesForm(process, hidden, 1.0, received, 10).growth for received in (1.0, 0.8))
    assert [exact.along(v) for v in np.eye(3)] == [True, False, False]
    assert [lossy.along(v) for v in np.eye(3)] == [True, None, False]
