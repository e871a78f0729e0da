"""The filter at the sensor, against a textbook Kalman filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from evedrop.model.local_filter import LocalFilter, Steps, settled
from evedrop.model.plant import Drive, Plant
from evedrop.model.process import Process, Trajectory, mistakes_of
from evedrop.model.streams import Batch
from tests.builders import stream_keys
from tests.examples import mostly_long

A = np.array([[1.0, 0.1], [0.0, 0.95]])
W = np.array([[1e-4, 0.0], [0.0, 4e-4]])
PROCESS = Process(A, np.eye(2), 0.04 * np.eye(2))
KEYS = stream_keys(8, ("process", "measurement"))


def plant(C: np.ndarray, V: np.ndarray, noise: np.ndarray = W) -> Plant:
    """One input, one disturbance, and what is measured."""
    inf = np.full(2, np.inf)
    return Plant(
        np.array([[0.3], [0.1]]), np.array([[0.0], [0.2]]), noise, np.array([1.0, -1.0]),
        np.array([-np.inf]), np.array([np.inf]), -inf, inf, C, V,
    )  # fmt: skip


ONE = plant(np.array([[1.0, 0.0]]), np.array([[0.01]]))
BOTH = plant(np.array([[1.0, 0.0], [0.5, 1.0]]), np.array([[0.01, 0.002], [0.002, 0.02]]))


@pytest.mark.parametrize("of", [ONE, BOTH], ids=["one", "both"])
def test_it_settles_where_the_riccati_equation_has_it(of: Plant) -> None:
    """Gain, covariance and K S Kᵀ of the stationary filter; of one measurement K S Kᵀ has rank one."""
    C, V = of.output_matrix, of.measurement_noise
    assert C is not None
    assert V is not None
    predicted = solve_discrete_are(A.T, C.T, W, V)
    S = C @ predicted @ C.T + V
    K = predicted @ C.T @ np.linalg.inv(S)
    step = settled(PROCESS, of)
    assert np.allclose(step.gain, K, rtol=1e-9)
    assert np.allclose(step.covariance, predicted - K @ C @ predicted, rtol=1e-8)
    assert np.allclose(step.innovation, K @ S @ K.T, rtol=1e-8)
    assert np.array_equal(step.innovation, step.innovation.T)
    assert np.linalg.matrix_rank(step.innovation, tol=1e-12) == len(C)
    entries = (A, step.innovation, PROCESS.initial_covariance)
    assert mistakes_of(*entries, len(C) == 1) == []
    assert (mistakes_of(*entries) == []) == (len(C) == 2)


def test_it_settles_in_any_units() -> None:
    """A state of variance 1e6 hides none of 1e-7; and states that die out do not keep it from settling."""
    of = plant(np.eye(2), np.diag([1e4, 1e-4]), np.diag([1e6, 1e-10]))
    process = Process(np.diag([0.9, 1.0]), np.eye(2), np.diag([1e6, 1e-6]))
    step = settled(process, of)
    for i, (a, q, r) in enumerate(((0.9, 1e6, 1e4), (1.0, 1e-10, 1e-4))):
        ((predicted,),) = solve_discrete_are([[a]], [[1.0]], [[q]], [[r]])
        assert step.gain[i, i] == pytest.approx(predicted / (predicted + r), rel=1e-7)
    dying = Process(np.diag([0.9, 0.98]), np.eye(2), np.eye(2))
    assert settled(dying, plant(np.eye(2), np.eye(2), np.diag([1.0, 0.0]))).covariance[1, 1] < 1e-10


def test_it_is_the_kalman_filter_slot_by_slot() -> None:
    """With inputs and disturbances known: estimates, covariances, and errors that are as large as it says."""
    batch = Batch(60, 4000)
    drive = Drive(ONE, np.linspace(-1.0, 1.0, 60)[:, None])
    trajectory = Trajectory(PROCESS, KEYS["process"], batch, None, W)
    local, steps = LocalFilter(PROCESS, ONE, KEYS["measurement"], batch), Steps(PROCESS, ONE)
    random = np.random.default_rng(1)
    C, P = ONE.output_matrix, PROCESS.initial_covariance
    assert C is not None
    x_before = np.zeros((2, 4000))
    for k in range(60):
        pushed = drive.pushed(k)
        x = trajectory.advance(pushed)
        x_hat = local.take(k, x, pushed)
        step = steps.next()
        P = P if k == 0 else A @ P @ A.T + W
        gain = P @ C.T / (C @ P @ C.T + 0.01)
        P = P - gain @ C @ P
        assert np.allclose(step.gain, gain, rtol=1e-8)
        assert np.allclose(step.covariance, P, rtol=1e-7)
        assert np.allclose(local.predicted, A @ x_before if k else 0.0)
        error = x - x_hat
        spread = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        assert np.abs((error @ error.T / 4000 - P) / spread).max() < 0.1
        added = x_hat - local.predicted - pushed
        assert np.allclose(added - gain @ np.linalg.lstsq(gain, added, rcond=None)[0], 0.0, atol=1e-12), "in K's range"
        drive.set_inputs(random.normal(size=(1, 4000)))
        x_before = x_hat


@pytest.mark.parametrize(
    ("C", "noise"),
    [
        pytest.param(np.array([[0.0, 1.0]]), W, id="a state that is not seen"),
        pytest.param(np.array([[1.0, 0.0]]), np.zeros((2, 2)), id="no noise", marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("judged", mostly_long([1024, 32_768], [1024]))
def test_a_filter_without_an_end_is_refused(
    C: np.ndarray, noise: np.ndarray, judged: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its covariance grows forever, or it trusts no measurement any more, after fewer slots than usual or after as many."""
    monkeypatch.setattr("evedrop.model.local_filter._JUDGED", judged)
    with pytest.raises(ValueError, match="does not settle"):
        settled(PROCESS, plant(C, np.array([[0.01]]), noise))


def test_a_settled_filter_stays_as_it_is() -> None:
    """The same step in every slot from then on."""
    steps = Steps(PROCESS, ONE)
    while not steps.settled:
        last = steps.next()
    assert steps.next() is last
    assert steps.next() is last


def test_a_plant_that_is_not_measured_has_no_filter() -> None:
    """Neither step by step, nor its end, nor its estimates."""
    of = replace(ONE, output_matrix=None, measurement_noise=None)
    for use in (
        lambda: Steps(PROCESS, of),
        lambda: settled(PROCESS, of),
        lambda: LocalFilter(PROCESS, of, KEYS["measurement"], Batch(2, 1)),
    ):
        with pytest.raises(ValueError, match="the plant's states are not measured"):
            use()


@pytest.mark.parametrize(
    ("A", "noise"),
    [(np.diag([0.5, 1.5]), W), (np.diag([0.5, 0.25]), np.zeros((2, 2)))],
    ids=["a state that overflows", "nothing to measure"],
)
def test_a_filter_that_ends_in_nothing_is_refused(A: np.ndarray, noise: np.ndarray) -> None:
    """Its covariance leaves double precision, or it settles on ignoring every measurement; and there is no warning."""
    with pytest.raises(ValueError, match="does not settle"):
        settled(Process(A, np.eye(2), np.eye(2)), plant(np.array([[1.0, 0.0]]), np.array([[0.01]]), noise))


def test_a_filter_of_many_states_is_given_up_sooner() -> None:
    """Of five states, one of which is never seen and drifts away."""
    five = np.eye(5)
    none = np.full(5, np.inf)
    of = Plant(
        np.zeros((5, 1)), np.zeros((5, 0)), 1e-3 * five, np.zeros(5), np.zeros(1), np.zeros(1), -none, none,
        five[:1], np.array([[0.01]]),
    )  # fmt: skip
    with pytest.raises(ValueError, match="does not settle"):
        settled(Process(five, five, five), of)
