"""Simulated event chains against theory, at five standard errors: a false alarm once in two million comparisons."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Action
from evedrop.model.theory.covariances import Outcomes, misled_covariances, theoretical_traces
from evedrop.model.update import actual_covariance
from evedrop.studies.papers import strategies

TRIALS = 20_000
SLOTS = 25
Q = np.array([[1e-3, 2e-4], [2e-4, 5e-4]])
UNSTABLE = Process(np.array([[1.0, 0.3], [0.5, 1.001]]), Q, Q)
MARGINAL = Process(np.array([[1.0, 0.1], [0.0, 1.0]]), Q, Q)  # a large Σ0 survives in events too rare to sample


def agrees(samples: Floats, expected: Floats) -> bool:
    """Whether means over trials (the last axis) are within five standard errors of the expected values."""
    error = samples.std(axis=-1, ddof=1) / np.sqrt(samples.shape[-1])
    return bool(np.all(np.abs(samples.mean(axis=-1) - expected) <= 5.0 * error + 1e-15))


def actions(gamma: NDArray[np.bool_], nu: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """What the legitimate estimator does: lost, innovation decoded, or state used."""
    return np.where(gamma, np.where(nu, np.uint8(Action.INNOVATION), np.uint8(Action.STATE)), np.uint8(Action.LOST))


@pytest.mark.parametrize("process", [UNSTABLE, MARGINAL], ids=["unstable", "marginal"])
@pytest.mark.parametrize(("b0", "b1"), [(1.0, 0.0), (1.0, 1.0), (0.8, 0.3)], ids=["smart", "naive", "suspicious"])
def test_simulated_covariances_average_to_the_expectation(process: Process, b0: float, b1: float) -> None:
    """Stepping covariances by random events reproduces E P_k for the legitimate estimator and for each strategy."""
    mu, mu_e, mu_d = 0.9, 0.85, 0.9
    random = np.random.default_rng(17)
    misled = misled_covariances(process, SLOTS)
    ours, theirs = np.empty((SLOTS, TRIALS)), np.empty((SLOTS, TRIALS))
    P = P_e = np.repeat(process.initial_covariance[:, :, None], TRIALS, axis=2)
    for k in range(SLOTS):
        gamma, gamma_e = random.random(TRIALS) < mu, random.random(TRIALS) < mu_e
        nu = (random.random(TRIALS) >= mu_d) & (k > 0)
        used = gamma_e & (random.random(TRIALS) < np.where(nu, b1, b0))
        P = actual_covariance(process, k, P, actions(gamma, nu), nu, misled[k])
        P_e = actual_covariance(process, k, P_e, np.where(used, np.uint8(Action.STATE), np.uint8(0)), nu, misled[k])
        ours[k], theirs[k] = np.trace(P), np.trace(P_e)
    assert agrees(ours, theoretical_traces(process, Outcomes.legitimate(mu, mu_d), SLOTS))
    assert agrees(theirs, theoretical_traces(process, Outcomes.eavesdropper(mu_e, mu_d, b0, b1), SLOTS))


def test_steps_are_the_three_cases() -> None:
    """Each event alone gives its own covariance: predicted, zero, carried or misled."""
    P = np.repeat(np.array([[2.0, 0.5], [0.5, 1.0]])[:, :, None], 3, axis=2)
    A, start = UNSTABLE.A, P[:, :, 0]
    nu = np.array([True, False, True])
    f = misled_covariances(UNSTABLE, 2)[1]
    after = actual_covariance(UNSTABLE, 1, P, actions(np.array([False, True, True]), nu), nu, f)
    for trial, expected in enumerate((A @ start @ A.T + Q, np.zeros((2, 2)), A @ start @ A.T)):
        assert after[:, :, trial] == pytest.approx(expected, rel=1e-14)
    used = np.array([Action.DISCARDED, Action.STATE, Action.STATE], np.uint8)
    after = actual_covariance(UNSTABLE, 1, P, used, nu, f)
    for trial, expected in enumerate((A @ start @ A.T + Q, np.zeros((2, 2)), f)):
        assert after[:, :, trial] == pytest.approx(expected, rel=1e-14)


def test_real_model_has_the_expected_error() -> None:
    """Squared error and reported trace of every receiver of the emulator agree with theory, slot by slot."""
    runs = strategies.simulate(20_000, lambda _: None)
    for name, outcomes in strategies.outcomes().items():
        for theory, (mean, error) in (
            (outcomes, runs.squared_error[name]),
            (outcomes.reported, runs.reported[name]),
        ):
            expected = theoretical_traces(strategies.process(), theory, strategies.SLOTS)
            assert np.all(np.abs(mean - expected) <= 5.0 * error + 1e-15), name
