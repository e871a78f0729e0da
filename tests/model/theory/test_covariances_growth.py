"""Where expected errors grow: the rule against long recursions, in each eigenspace and between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evedrop.model import modulated
from evedrop.model.links.chain import Chain
from evedrop.model.process import Process
from evedrop.model.schedule import NoiseDistribution
from evedrop.model.theory.closed_forms import ClearStatesForm, SensorChain, TakesNoise, reference_limit
from evedrop.model.theory.covariances import (
    NOBODY,
    Outcomes,
    growth,
    limit_trace,
    radius,
    stability_bound,
    theoretical_covariances,
    theoretical_traces,
)

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


STILL = Process(np.diag([1.0, 0.5]), np.diag([0.0, 0.25]), np.eye(2), singular_noise=True)
"""Its first state is constant."""
DRIVEN = replace(STILL, A=np.array([[1.0, 1.0], [0.0, 0.5]]))
"""Its first state is moved by the second."""
GROWING = replace(STILL, A=np.diag([1.25, 0.5]))
MISLED = Outcomes.eavesdropper(0.5, 0.5, 1.0, 1.0)


@pytest.mark.parametrize("outcomes", [NOBODY, MISLED])
def test_the_error_in_a_constant_state_without_noise_has_no_known_limit(outcomes: Outcomes) -> None:
    """It stays bounded, however long, and depends on the start; a moved or growing state's error has no bound."""
    late = theoretical_covariances(STILL, outcomes, 3000)[:, 0, 0]
    assert late[-1] == pytest.approx(late[500], rel=1e-9)
    assert late[-1] > 0.0
    assert np.isnan(limit_trace(STILL, outcomes))
    assert growth(STILL, outcomes).along(np.array([1.0, 0.0])) is None
    assert growth(STILL, outcomes).along(np.array([0.0, 1.0])) is False
    for process in (DRIVEN, GROWING):
        traces = theoretical_traces(process, outcomes, 1000)
        assert traces[-1] > 1.5 * traces[500]
        assert limit_trace(process, outcomes) == np.inf
        assert growth(process, outcomes).along(np.array([1.0, 0.0])) is True


def test_every_theory_of_a_limit_knows_states_without_noise() -> None:
    """Closed forms, and links in bursts; a packet that is the state ends the error, however it began."""
    bursts = Chain(np.array([[0.9, 0.1], [0.2, 0.8]]), np.array([2 / 3, 1 / 3]), np.array([0.9, 0.1]))
    distribution = NoiseDistribution(np.eye(2))
    chain = SensorChain(np.array([1.0]), np.array([[0.0]]), np.array([[1.0]]))
    for process, unknown in ((STILL, np.nan), (DRIVEN, np.inf), (GROWING, np.inf)):
        limits = [
            modulated.limit_trace(process, bursts, lambda mu: Outcomes.eavesdropper(mu, 0.5, 1.0, 1.0)),
            modulated.limit_trace(process, bursts, lambda _: NOBODY),
            TakesNoise(process, distribution, 0.5, 0.5, (1.0, 1.0), 50).limit,
            np.trace(chain.limit(process)),
            reference_limit(process, 0.5, (0.5, 0.5)),
            ClearStatesForm(process, np.array([True, False]), 1.0, 1.0, 50).limit if process is not DRIVEN else unknown,
        ]
        expected = [unknown] * 5 + [1.0 if process is STILL else unknown]
        np.testing.assert_allclose(limits, expected)
    assert np.isfinite(modulated.limit_trace(STILL, bursts, lambda mu: Outcomes.eavesdropper(mu, 0.5, 1.0, 0.0)))
    assert limit_trace(STILL, Outcomes.plain(0.5)) < np.inf


def test_a_growing_state_without_noise_that_is_known_at_the_start_stays_known() -> None:
    """Behind a lossless link, slot 0 tells the state; only its loss would let the error grow."""
    heard = Outcomes.eavesdropper(1.0, 0.2, 1.0, 0.0)
    assert theoretical_covariances(GROWING, heard, 500)[-1, 0, 0] == 0.0
    assert np.isnan(limit_trace(GROWING, heard))
    assert growth(GROWING, heard).along(np.array([1.0, 0.0])) is None
    assert limit_trace(GROWING, replace(heard, initial=0.1)) == np.inf
