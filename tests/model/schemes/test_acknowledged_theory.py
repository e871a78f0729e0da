"""Theory of state-secrecy codes: expectations, the floor, and the example of the paper."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.reference_form import reference_floor
from evedrop.model.schemes.acknowledged import Acknowledged, OpenLoop
from evedrop.model.theory.closed_forms import reference_covariances
from evedrop.model.theory.covariances import theoretical_covariances
from evedrop.scenario.loading import checked
from evedrop.scenario.theory import expectations_of
from tests.builders import DRIFTING, UNSTABLE
from tests.model.acknowledged_runs import MIXED, all_events, exact_sigmas, played_over
from tests.model.slot_loop import STABLE


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
@pytest.mark.parametrize("rule", ["honest", "blocked", "critical blocked", "forged"])
def test_expectations_are_the_recursion(process: Process, rule: str) -> None:
    """E P of both receivers over every course of four slots, each with its probability, is the recursion's, exactly."""
    gamma, gamma_e, link = all_events(4)
    acks = {
        "honest": gamma & link,
        "blocked": np.zeros_like(gamma),
        "critical blocked": gamma & gamma_e & link,
        "forged": link,
    }[rule]
    mu, mu_e, arrives = 0.7, 0.6, 0.8
    played = played_over(process, gamma, gamma_e, acks, OpenLoop)
    weights = np.where(gamma, mu, 1 - mu) * np.where(gamma_e, mu_e, 1 - mu_e) * np.where(link, arrives, 1 - arrives)
    chances = weights.prod(0)
    assert np.isclose(chances.sum(), 1.0)
    for name, heard, quality in (("legitimate", gamma, mu), ("eve", gamma_e, mu_e)):
        joint = [float(chances[acks[0] & (heard[0] == flag)].sum()) for flag in (True, False)]
        expected = reference_covariances(process, quality, (joint[0], joint[1]), 4)
        for k, belief in enumerate(played.beliefs[name]):
            assert np.allclose(belief.P @ chances, expected[k], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize(
    "process", [UNSTABLE, *(pytest.param(stable, marks=pytest.mark.long) for stable in (STABLE, MIXED))]
)
@pytest.mark.parametrize("back", [0.0, 0.8])
def test_the_floor_is_below_the_exact_expectation(process: Process, back: float) -> None:
    """Over every course of five slots: a bound in each slot, exact without critical slots, and close to what it bounds."""
    slots = 5
    gamma, gamma_e, link = all_events(slots)
    mu, mu_e = 0.7, 0.9
    played = played_over(process, gamma, gamma_e, gamma & link)
    weights = np.where(gamma, mu, 1 - mu) * np.where(gamma_e, mu_e, 1 - mu_e) * np.where(link, back, 1 - back)
    chances = weights.prod(0)
    acknowledged = (mu * back * mu_e, mu * back * (1.0 - mu_e))
    floor = reference_floor(process, mu_e, acknowledged, slots)
    exact_traces = np.array([np.trace(belief.P @ chances) for belief in played.beliefs["eve"]])
    assert (floor <= exact_traces * (1 + 1e-9)).all()
    assert (floor >= (0.9 if back else 1 - 1e-9) * exact_traces).all()


def test_the_floor_follows_many_slots() -> None:
    """Of hundreds of critical slots some stand for others: the bound falls by little, and reaches the error of not listening."""
    result = reference_floor(STABLE, 0.9, (0.81, 0.09), 400)
    sigma = list(itertools.islice(exact_sigmas(STABLE), 400))[-1]
    assert result[-1] == pytest.approx(np.trace(sigma), rel=1e-6)
    assert result[-1] <= np.trace(sigma) * (1 + 1e-12)
    seldom = reference_floor(STABLE, 0.9, (0.9, 1e-3), 400)
    assert 0.2 * np.trace(sigma) < seldom[-1] < (1.0 - 0.999**400) * np.trace(sigma) + 0.1 * np.trace(sigma)
    assert np.isinf(reference_floor(MIXED, 0.9, (0.81, 0.09), 3000)[-1])


@pytest.mark.parametrize("singular", [False, True], ids=["Q nonsingular", "Q singular"])
@pytest.mark.parametrize("start", [1.0, 1e3, 1e8])
def test_the_floor_holds_for_a_state_that_shrinks(start: float, singular: bool) -> None:
    """The error of one critical slot by plain covariances: however large the state is at first, and close where they are rare."""
    A = np.array([[0.97, 0.3], [0.0, 0.9]])
    Q = np.array([[1.0, 0.5], [0.5, 0.25 if singular else 1.0]])
    slots, c = 300, 1e-6
    floor = reference_floor(Process(A, Q, start * np.eye(2), singular), 1.0 - c, (1.0 - c, c), slots)
    sigma = list(itertools.islice(exact_sigmas(Process(A, Q, start * np.eye(2), singular)), slots))
    exact_traces = c * np.array([np.trace(matrix) for matrix in sigma])
    back = np.linalg.inv(A).T
    G = np.array([[1.0], [0.5]]) if singular else np.linalg.cholesky(Q)
    F = np.empty((0, 2, 2))
    for k in range(1, slots):
        H = G.T @ back @ np.linalg.inv(sigma[k - 1])
        L = A + G @ H
        shown = H @ F @ H.T + np.eye(G.shape[1])
        gain = L @ F @ H.T @ np.linalg.inv(shown)
        left = L - gain @ H
        F = np.concatenate([left @ F @ left.swapaxes(1, 2) + gain @ gain.swapaxes(1, 2), Q[None]])
        exact_traces[k] += c * np.trace(F, axis1=1, axis2=2).sum()
    assert (floor <= exact_traces * (1.0 + 1e-6)).all()
    assert (floor[:60] >= exact_traces[:60] * (1.0 - 1e-3)).all()
    assert singular or (floor >= 0.9 * exact_traces).all()


@pytest.mark.parametrize(
    ("initial", "honest"), [(1e-3 * np.eye(2), 4.91e7), (np.eye(2), 2.36e10)], ids=["from Q", "from I"]
)
def test_the_papers_example(initial: np.ndarray, honest: float) -> None:
    """Slot 40, μ = μ_e = 0.9: lost for good with honest acknowledgements; as good as legitimate where the critical ones fail."""
    process = Process(UNSTABLE.A, UNSTABLE.Q, initial)
    result = reference_covariances(process, 0.9, (0.81, 0.09), 41)
    assert np.trace(result[40]) == pytest.approx(honest, rel=2e-3)
    legitimate = np.trace(theoretical_covariances(process, Acknowledged(process).outcomes(0.9), 41)[40])
    assert legitimate == pytest.approx(2.284e-4, rel=2e-4)
    for acknowledged in ((0.0, 0.0), (0.81, 0.0)):
        blocked = np.trace(reference_covariances(process, 0.9, acknowledged, 41)[40])
        assert blocked == pytest.approx(legitimate, rel=1e-12)


def test_an_error_that_is_bounded_is_expected_to_be() -> None:
    """With L = A and a stable process, what the eavesdropper and an estimator of forged acknowledgements lost is forgotten."""
    tables: dict[str, Any] = {
        "title": "Forged",
        "slots": 400,
        "process": {"A": STABLE.A.tolist(), "Q": STABLE.Q.tolist(), "initial_covariance": np.eye(2).tolist()},
        "encoding": {"scheme": "open-loop"},
        "acknowledgements": {"link": {"quality": 0.9}, "attack": "flip", "flip": 0.1},
        "legitimate": {"link": {"quality": 0.8}},
        "eavesdroppers": {"eve": {"strategy": "reference", "link": {"quality": 0.6}}},
    }
    for expected in expectations_of(checked(tables, "it")).values():
        assert not expected.infinite_variance
        assert expected.limit == pytest.approx(expected.traces(400)[-1], rel=1e-9)
    tables |= {"slots": 100, "process": {**tables["process"], "A": MIXED.A.tolist()}}
    assert {expected.limit for expected in expectations_of(checked(tables, "it")).values()} == {np.inf}
