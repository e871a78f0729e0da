"""The plant and its controllers, compared with plain linear algebra."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from evedrop.live.protocol.json_tables import plain, read
from evedrop.model.controllers import CONTROLLERS, Assignment, Lqr, gain, held
from evedrop.model.kernels.elementary import semidefinite_factor
from evedrop.model.plant import Drive, InputAwareEstimator, Offset, Plant
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Action, Reception
from evedrop.model.schemes import scheme_of
from evedrop.model.slot.cores import ControllerCore
from evedrop.model.streams import Batch, root_of_seed, stream_key
from tests.builders import stream_keys

B = 1e-3 * np.array([[1.56, 1.56], [-5.66, 0.0]])
KEY = stream_key(root_of_seed(9), "process")


def plant(B: np.ndarray = B, **changes: np.ndarray) -> Plant:
    """A plant without disturbances, noise and limits, but for what is changed."""
    n, m = B.shape
    entries = {
        "input_matrix": B,
        "disturbance_matrix": np.zeros((n, 0)),
        "noise": np.zeros((n, n)),
        "start": np.zeros(n),
        "input_lower": np.full(m, -np.inf),
        "input_upper": np.full(m, np.inf),
        "state_lower": np.full(n, -np.inf),
        "state_upper": np.full(n, np.inf),
    }
    return Plant(**{**entries, **changes})


def assignment(A: np.ndarray, of: Plant, period: int = 1, rate: float = 0.0, limit: float = np.inf) -> Assignment:
    """Weights of 1 and 0.1, and a weight of the inputs' change."""
    n, m = of.input_matrix.shape
    process = Process(A, np.eye(n), np.eye(n))
    weights = (np.linspace(1.0, 0.3, n), np.full(m, 0.1), np.full(m, rate))
    return Assignment(process, of, period, 1.0, *weights, np.full(m, limit), {})


def test_the_gain_does_not_depend_on_the_units_of_states() -> None:
    """Two inputs that drive one state each are two regulators, also where the weights are 1e16 apart."""
    A, weights = np.diag([0.5, 1.0]), np.array([1e8, 1e-8])
    both = replace(assignment(A, plant(np.eye(2))), state_weights=weights, input_weights=np.ones(2))
    for i in range(2):
        a, q = A[i, i], weights[i]
        ((X,),) = solve_discrete_are([[a]], [[1.0]], [[q]], [[1.0]])
        assert gain(both)[i, i] == pytest.approx(X * a / (1.0 + X), rel=1e-8)


@pytest.mark.parametrize("period", [1, 7])
@pytest.mark.parametrize("rate", [0.0, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_the_gain_is_that_of_the_riccati_equation(seed: int, rate: float, period: int) -> None:
    """Against scipy, on the state augmented by the previous inputs, for random systems and held inputs."""
    random = np.random.default_rng(seed)
    n, m = 3, 2
    A = random.normal(size=(n, n)) if period == 1 else np.eye(n) + 0.1 * random.normal(size=(n, n))
    asked = assignment(A, plant(random.normal(size=(n, m))), period, rate)
    power, driven = held(asked)
    assert np.allclose(power, np.linalg.matrix_power(A, period))
    F, G = np.zeros((n + m, n + m)), np.vstack([driven, np.eye(m)])
    F[:n, :n] = power
    Q, S = np.zeros((n + m, n + m)), np.zeros((n + m, m))
    Q[:n, :n], Q[n:, n:], S[n:] = np.diag(asked.state_weights), rate * np.eye(m), -rate * np.eye(m)
    R = np.diag(asked.input_weights + asked.rate_weights)
    X = solve_discrete_are(F, G, Q, R, s=S)
    assert np.allclose(gain(asked), np.linalg.solve(R + G.T @ X @ G, G.T @ X @ F + S.T), rtol=1e-9, atol=1e-12)


def test_what_no_input_reaches_has_no_regulator() -> None:
    """A weighted state that grows and is not reached is an objection, and so is an input without any weight."""
    beyond = assignment(np.diag([1.0, 1.2]), plant(np.array([[1.0], [0.0]])))
    [(entry, sentence)] = Lqr.objections(beyond)
    assert entry == "state_weights"
    assert "no input can keep from growing" in sentence
    free = Assignment(beyond.process, beyond.plant, 1, 1.0, np.ones(2), np.zeros(1), np.zeros(1), np.zeros(1), {})
    assert Lqr.objections(free)[0][0] == "input_weights"
    assert Lqr.objections(assignment(np.eye(2), plant())) == []


def test_inputs_stay_within_their_limits_and_rates() -> None:
    """However far off the state is: first what an input may change by, then what it may be."""
    narrow = plant(input_lower=np.array([-1.5, -0.5]), input_upper=np.array([1.5, 0.5]))
    regulator = Lqr(assignment(np.eye(2), narrow, limit=0.4), 3)
    before = np.zeros((2, 3))
    for k in range(10):
        u = regulator.decide(k, np.array([[50.0, -50.0, 0.0]] * 2), np.zeros(0))
        assert np.all(np.abs(u - before) <= 0.4 + 1e-15)
        before = u
    assert np.array_equal(before[:, 2], [0.0, 0.0])
    assert np.array_equal(np.abs(before[1, :2]), [0.5, 0.5])


@pytest.mark.parametrize("strategy", sorted(set(CONTROLLERS) & {"lqr"}))
def test_a_trial_alone_is_steered_as_among_others(strategy: str) -> None:
    """To the last bit, slot by slot."""
    asked, random = assignment(np.eye(2), plant(), rate=0.2, limit=0.1), np.random.default_rng(5)
    many, alone = CONTROLLERS[strategy](asked, 17), CONTROLLERS[strategy](asked, 1)
    for k in range(20):
        x_hat = random.normal(size=(2, 17))
        u = many.decide(k, x_hat, np.zeros(0))
        assert np.array_equal(u[:, 4:5], alone.decide(k, x_hat[:, 4:5], np.zeros(0)))
        assert not many.failed.any()


def test_the_core_of_the_controller_decides_as_its_strategy() -> None:
    """From the disturbances of the slot; it says what failed, and how long the decision took."""
    asked, random = assignment(np.eye(2), plant(), period=3, limit=0.1), np.random.default_rng(6)
    disturbances = np.zeros((10, 0))
    core, strategy = ControllerCore("lqr", asked, disturbances, 5), CONTROLLERS["lqr"](asked, 5)
    assert core.period == 3
    for k in (0, 3, 6):
        x_hat = random.normal(size=(2, 5))
        decision = core.decide(k, x_hat)
        assert np.array_equal(decision.u, strategy.decide(k, x_hat, disturbances[k]))
        assert decision.failed.tolist() == [False] * 5
        assert decision.seconds >= 0.0


def test_states_are_moved_by_inputs_disturbances_and_noise() -> None:
    """x_0 = start + L0 ξ, then A x + w + B u + B_d d with u within its limits: against plain matrix products."""
    A, noise = np.array([[1.0, 0.2], [0.0, 0.9]]), np.array([[4e-4, 2e-4], [2e-4, 1e-4]])
    process, batch = Process(A, np.eye(2), 0.25 * np.eye(2)), Batch(30, 4)
    of = plant(
        noise=noise, start=np.array([3.0, -2.0]), disturbance_matrix=np.array([[0.5], [-0.1]]), input_upper=np.ones(2)
    )
    random = np.random.default_rng(2)
    d, u = random.normal(size=(30, 1)), 2.0 * random.normal(size=(30, 2, 4))
    drive, trajectory = Drive(of, d), Trajectory(process, KEY, batch, None, noise)
    quiet = Trajectory(Process(A, 1e-300 * np.eye(2), process.initial_covariance), KEY, batch)
    states = []
    for k in range(30):
        states.append(trajectory.advance(drive.pushed(k)))
        drive.set_inputs(u[k])
    assert np.allclose(states[0], quiet.advance() + of.start[:, None])
    rest = []
    for k in range(1, 30):
        moved = (
            A @ states[k - 1]
            + B @ np.minimum(u[k - 1], 1.0)
            + np.outer(of.disturbance_matrix, d[k - 1, 0] * np.ones(4))
        )
        rest.append(states[k] - moved)
    white = np.concatenate(rest, axis=1)
    assert np.allclose(white[0], 2.0 * white[1], atol=1e-12), "noise of a singular covariance stays in its range"
    assert 0.01 < white[0].std() < 0.03
    assert np.array_equal(of.clips(u), (u > 1.0).any(axis=1))


def test_a_semidefinite_matrix_is_factored() -> None:
    """Of every rank, 0 included; what has a negative eigenvalue is refused."""
    random = np.random.default_rng(1)
    for rank in range(4):
        half = random.normal(size=(3, rank))
        M = half @ half.T
        L = semidefinite_factor(M)
        assert np.allclose(L @ L.T, M, atol=1e-10)
        assert np.count_nonzero(np.diag(L)) == rank
        assert np.array_equal(L, np.tril(L))
    for wrong in (np.diag([1.0, -1e-3]), np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[1.0, 2.0], [2.0, 1.0]])):
        with pytest.raises(ValueError, match="not positive semidefinite"):
            semidefinite_factor(wrong)


def test_a_plant_survives_its_brief() -> None:
    """Numbers, and absent limits, come back from the text of a brief."""
    of = plant(input_lower=np.array([-1.0, -np.inf]), disturbance_matrix=np.ones((2, 3)))
    again = read(Plant, json.loads(json.dumps(of, default=plain)))
    assert all(np.array_equal(getattr(of, name), getattr(again, name)) for name in Plant.__dataclass_fields__)
    asked = assignment(np.eye(2), of, period=3, limit=0.5)
    text = json.dumps(asked, default=plain)
    back = read(Assignment, json.loads(text))
    assert np.array_equal(back.rate_limits, asked.rate_limits)
    assert json.dumps(back, default=plain) == text


def test_who_is_told_the_inputs_predicts_with_them() -> None:
    """A x̂ + B u where nothing was received; the other estimate and the offset between the two give the same number."""
    process, batch = Process(np.array([[1.0, 0.1], [0.0, 0.9]]), 1e-4 * np.eye(2), np.eye(2)), Batch(200, 5)
    scheme = scheme_of(process, {"scheme": "innovation", "state_probability": 0.4})
    secret = stream_keys(1, scheme.secret_streams)
    random, of = np.random.default_rng(3), plant()
    drive, trajectory = Drive(of, np.zeros((200, 0))), Trajectory(process, KEY, batch, None, of.noise)
    encoder = scheme.encoder(secret, batch)
    unaware, offset = scheme.estimator(secret, batch), Offset(process, of, 5)
    aware = InputAwareEstimator(scheme.estimator(secret, batch), of)
    prior, other = aware.prior(), unaware.prior()
    errors = []
    for k in range(200):
        x = trajectory.advance(drive.pushed(k))
        packet = encoder.encode(k, x, trajectory.predicted)
        heard = Reception(random.random(5) < 0.5, packet.z)
        prior, other = aware.step(k, prior, heard), unaware.step(k, other, heard)
        u = random.normal(size=(2, 5))
        assert np.allclose(prior.x_hat, other.x_hat + offset.next(other.action[None], u[None])[0], atol=1e-12)
        assert np.array_equal(prior.P, other.P)
        if (prior.action == Action.STATE).all():
            assert np.array_equal(prior.x_hat, x)
        drive.set_inputs(u)
        aware.learn(k, u)
        errors.append((np.abs(x - prior.x_hat).max(), np.abs(x - other.x_hat).max()))
    aware_errors = np.array(errors)[60:]
    assert aware_errors[:, 0].max() < 1e-9, (
        "without noise, a receiver that knows the inputs and has had one state knows all"
    )
    assert aware_errors[:, 1].max() > 1e-3


def test_a_riccati_equation_without_a_solution_is_said_to_have_none() -> None:
    """A drifting state that no input reaches but that is weighed, and numbers in which the equation loses all its digits."""
    unreached = assignment(np.eye(2), plant(np.array([[1.0], [0.0]])))
    large = replace(assignment(np.eye(2), plant(np.full((2, 1), 1e12))), state_weights=np.ones(2))
    for asked in (unreached, large):
        with pytest.raises(ValueError, match="the Riccati equation has no solution"):
            gain(asked)
        ((entry, sentence),) = Lqr.objections(asked)
        assert (entry, sentence.partition(":")[0]) == (
            "state_weights",
            "weigh a state that no input can keep from growing",
        )


def test_weights_that_leave_double_precision_are_refused() -> None:
    """No regulator decides inputs that are not numbers."""
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.1], [0.0]])
    asked = replace(assignment(A, plant(B)), state_weights=np.array([1e308, 1.0]))
    with pytest.raises(ValueError, match="the weights leave double precision"):
        gain(asked)
    assert [entry for entry, _ in Lqr.objections(asked)] == ["state_weights"]


def test_the_inputs_change_nothing_of_what_an_estimator_does() -> None:
    """Its action is that of the estimator without them."""
    process, batch = Process(np.eye(2), np.eye(2), np.eye(2)), Batch(3, 4)
    scheme = scheme_of(process, {"scheme": "plain"})
    aware = InputAwareEstimator(scheme.estimator({}, batch), plant())
    gamma = np.array([True, False, True, False])
    assert np.array_equal(aware.act(1, gamma), [Action.STATE, Action.LOST, Action.STATE, Action.LOST])
