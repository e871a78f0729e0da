"""Model predictive control against a quadratic programme solved otherwise, its limits, and what it does when it cannot."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from evedrop.model import controllers
from evedrop.model.controllers import CONTROLLERS, Assignment, Mpc
from evedrop.model.plant import Plant
from evedrop.model.process import Process

pytest.importorskip("osqp", reason="model predictive control needs the extra `microgrid`")

B = 1e-3 * np.array([[1.56, 1.56], [-5.66, 0.0]])
B_D = 1e-3 * np.array([[1.56, -1.56], [0.0, 0.0]])
PERIOD = 60


def assigned(horizon: int = 8, **changed: Any) -> Assignment:
    """The microgrid's controller, changed in some entries of the assignment or the plant."""
    plant = Plant(
        B, B_D, np.zeros((2, 2)), np.zeros(2), np.array([-1.5, -3.0]), np.array([1.5, 3.0]),
        np.array([-35.0, -40.0]), np.array([35.0, 40.0]),
    )  # fmt: skip
    of_plant = {name: changed.pop(name) for name in list(changed) if name in Plant.__dataclass_fields__}
    made = Assignment(
        Process(np.eye(2), 1e-5 * np.eye(2), 1e-5 * np.eye(2)), replace(plant, **of_plant), PERIOD, 1.0,
        np.array([1.0, 0.3]), np.array([0.02, 0.05]), np.array([1.0, 0.02]), np.array([3.0, 180.0]),
        {"horizon": horizon, "soft": 1000.0},
    )  # fmt: skip
    return replace(made, **changed)


@cache
def carried(A: bytes) -> tuple[np.ndarray, np.ndarray]:
    """A^PERIOD, and the sum of all lower powers of A, multiplied one after the other."""
    power, total = np.eye(2), np.zeros((2, 2))
    for _ in range(PERIOD):
        total, power = total + power, power @ np.frombuffer(A).reshape(2, 2)
    return power, total


def cost(inputs: np.ndarray, given: Assignment, x: np.ndarray, d: np.ndarray) -> float:
    """What the inputs of the horizon cost, from the definition; inputs before are 0.

    x ← A x + B u + B_d d, PERIOD times with the same u and d, is A^PERIOD x + (I + A + ... + A^(PERIOD − 1)) (B u + B_d d).
    """
    over, pushed = carried(given.process.A.tobytes())
    total, before = 0.0, np.zeros(2)
    for u in inputs.reshape(-1, 2):
        x = over @ x + pushed @ (given.plant.input_matrix @ u + given.plant.disturbance_matrix @ d)
        beyond = np.maximum(x - given.plant.state_upper, 0.0) + np.maximum(given.plant.state_lower - x, 0.0)
        total += given.state_weights @ x**2 + given.input_weights @ u**2
        total += given.rate_weights @ (u - before) ** 2 + given.parameters["soft"] * float(beyond @ beyond)
        before = u
    return total


@pytest.mark.parametrize(
    ("x", "d", "changed"),
    [
        ([0.8, -0.3], [0.0, 0.0], {}),
        ([0.2, 0.1], [2.0, 0.5], {}),
        ([6.0, -5.0], [0.0, 4.0], {}),
        ([0.8, -0.3], [1.0, 0.0], {"state_upper": np.array([0.5, 40.0])}),
        ([0.5, 0.5], [0.0, 0.0], {"process": Process(np.array([[1.0, 1e-3], [0.0, 0.999]]), np.eye(2), np.eye(2))}),
    ],
)
def test_it_is_the_best_there_is(x: list[float], d: list[float], changed: dict[str, Any]) -> None:
    """Its first inputs are those of a general optimiser on the definition, to some watts; limits may be at work."""
    given = assigned(horizon=4, **changed)
    state, disturbances = np.array(x), np.array(d)
    limits = [(-1.5, 1.5), (-3.0, 3.0)] * 4
    best = minimize(
        cost, np.zeros(8), (given, state, disturbances), "L-BFGS-B", bounds=limits,
        options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 5000, "maxfun": 100_000},
    )  # fmt: skip
    controller = Mpc(given, 1)
    u = controller.decide(0, state[:, None], disturbances)
    assert not controller.failed.any()
    assert np.allclose(u[:, 0], best.x[:2], atol=5e-3)


def test_inputs_keep_their_limits_and_change_by_no_more_than_they_may() -> None:
    """Far from where it should be every limit is reached and none is passed, to the last bit."""
    given = assigned(rate_limits=np.array([0.25, 0.5]))
    controller = Mpc(given, 1)
    before = np.zeros((2, 1))
    reached = np.zeros((2, 1))
    for k in range(20):
        u = controller.decide(k * PERIOD, np.array([[20.0], [20.0]]), np.array([0.0, 0.0]))
        assert np.all(np.abs(u - before) <= given.rate_limits[:, None] + 1e-15)
        assert np.all(u >= given.plant.input_lower[:, None])
        assert np.all(u <= given.plant.input_upper[:, None])
        before, reached = u, np.minimum(reached, u)
    assert reached[1, 0] == -3.0


def test_without_limits_it_is_the_regulators() -> None:
    """Over a long horizon, without limits or disturbances, its first inputs are those of the linear quadratic regulator."""
    free = {"input_lower": np.full(2, -np.inf), "input_upper": np.full(2, np.inf)}
    free |= {"state_lower": np.full(2, -np.inf), "state_upper": np.full(2, np.inf)}
    given = assigned(horizon=60, rate_limits=np.full(2, np.inf), **free)
    x = np.array([[0.4, -1.0], [0.2, 0.7]])
    regulator, controller = CONTROLLERS["lqr"](replace(given, parameters={}), 2), Mpc(given, 2)
    for k in (0, PERIOD):
        nothing = np.zeros(2)
        assert np.allclose(controller.decide(k, x, nothing), regulator.decide(k, x, nothing), atol=3e-3)


def test_a_trial_does_not_depend_on_the_others() -> None:
    """Each has a solver of its own: among three it decides what it decides alone, to the last bit."""
    rng = np.random.default_rng(2)
    together, alone = Mpc(assigned(), 3), Mpc(assigned(), 1)
    for k in range(6):
        x, d = rng.standard_normal((2, 3)), rng.uniform(0.0, 3.0, 2)
        both = together.decide(k * PERIOD, x, d)
        assert np.array_equal(both[:, 1:2], alone.decide(k * PERIOD, x[:, 1:2], d))


def test_where_there_is_no_solution_the_inputs_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that is given no time fails; it is said for each trial, and the inputs stay what they were."""
    controller = Mpc(assigned(), 2)
    x = np.array([[1.0, 2.0], [0.0, 0.0]])
    u = controller.decide(0, x, np.zeros(2))
    assert not controller.failed.any()
    controller.solvers[1].update_settings(max_iter=1)
    again = controller.decide(PERIOD, -x, np.zeros(2))
    assert controller.failed.tolist() == [False, True]
    assert np.array_equal(again[:, 1], u[:, 1])
    assert not np.array_equal(again[:, 0], u[:, 0])
    controller.solvers[1].update_settings(max_iter=4000)
    assert not np.array_equal(controller.decide(2 * PERIOD, -x, np.zeros(2))[:, 1], u[:, 1])
    assert not controller.failed.any()


@pytest.mark.parametrize(
    ("given", "entry"),
    [
        ({"horizon": 0}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"horizon": True}, "horizon"),
        ({"soft": 0.0}, "soft"),
    ],
)
def test_parameters_that_are_none_are_said(given: dict[str, Any], entry: str) -> None:
    """Which entry, what was found, an example."""
    ((place, sentence),) = Mpc.mistakes(given)
    assert place == entry
    assert "expected a" in sentence
    assert Mpc.mistakes({"horizon": 60, "soft": 1000}) == []


def test_without_the_solver_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line with the command; with it, only inputs without weight are objected to."""
    assert Mpc.objections(assigned()) == []
    ((entry, _),) = Mpc.objections(assigned(input_weights=np.zeros(2), rate_weights=np.zeros(2)))
    assert entry == "input_weights"
    monkeypatch.setattr(controllers, "find_spec", lambda _: None)
    ((entry, sentence),) = Mpc.objections(assigned())
    assert entry == "strategy"
    assert "pip install '.[microgrid]' in the checkout" in sentence


def test_the_strategy_is_registered_with_defaults() -> None:
    """A scenario may leave horizon and soft out."""
    assert CONTROLLERS["mpc"] is Mpc
    assert MappingProxyType({"horizon": 60, "soft": 1000.0}) == Mpc.optional


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"period": 0}, "period is 0, expected 1 to 1000000"),
        ({"period": 10**12}, "period is 1000000000000, expected 1 to 1000000"),
        ({"slot_seconds": -1.0}, "slot_seconds is -1.0, expected 0 or more"),
    ],
)
def test_an_assignment_that_nobody_can_follow_is_refused(changed: dict[str, Any], said: str) -> None:
    """A controller multiplies matrices for each slot of a period, which would take for ever."""
    with pytest.raises(ValueError, match=said):
        assigned(**changed)
