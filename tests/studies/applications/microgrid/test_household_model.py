"""The other loop that sees the truth, and the load as a neighbour guesses it, against plain simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evedrop.model.controllers import CONTROLLERS, Assignment
from evedrop.model.plant import Plant
from evedrop.model.process import Process
from evedrop.studies.applications.microgrid.household import HousePlaces, LoadGuess, PerfectLoop

PERIOD, SLOTS = 5, 60
A = np.array([[1.0, 0.01], [0.0, 0.99]])
B = np.array([[0.02, 0.03], [-0.05, 0.0]])
B_D = np.array([[0.03, -0.03], [0.0, 0.0]])
PLANT = Plant(
    B, B_D, np.zeros((2, 2)), np.zeros(2), np.array([-1.0, -2.0]), np.array([1.0, 2.0]),
    np.full(2, -np.inf), np.full(2, np.inf),
)  # fmt: skip
GIVEN = Assignment(
    Process(A, 1e-4 * np.eye(2), np.eye(2)), PLANT, PERIOD, 1.0, np.array([1.0, 0.3]), np.array([0.02, 0.05]),
    np.array([0.1, 0.02]), np.array([5.0, 5.0]), {},
)  # fmt: skip


def loop(noise: np.ndarray, seen: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States and inputs (slots, 2, R) of a loop whose controller sees x + seen."""
    controller = CONTROLLERS["lqr"](GIVEN, noise.shape[2])
    x, u = np.zeros(noise.shape), np.zeros(noise.shape)
    state = np.ones((2, noise.shape[2]))
    for k in range(len(noise)):
        x[k] = state
        if k % PERIOD == 0:
            decided = np.clip(
                controller.decide(k, state + seen[k], d[k]), PLANT.input_lower[:, None], PLANT.input_upper[:, None]
            )
        u[k] = decided
        state = A @ state + B @ u[k] + (B_D @ d[k])[:, None] + noise[k]
    return x, u


def test_the_other_loop_is_the_one_that_sees_the_truth() -> None:
    """Its inputs, found from this loop's states and inputs alone, are those of a simulation with the same noise."""
    rng = np.random.default_rng(1)
    noise, seen = 0.05 * rng.standard_normal((2, SLOTS, 2, 3))
    d = rng.uniform(0.0, 2.0, (SLOTS, 2))
    x, u = loop(noise, 10.0 * seen, d)
    _, wanted = loop(noise, 0.0 * seen, d)
    other = PerfectLoop(GIVEN.process, PLANT, CONTROLLERS["lqr"](GIVEN, 3), PERIOD, d)
    inputs_ = np.concatenate([other.follow(x[:3], u[:3]), other.follow(x[3:], u[3:])])
    assert np.abs(u - wanted).max() > 0.1
    assert np.allclose(inputs_, wanted, atol=1e-10)


def test_the_other_loop_has_the_same_watermark() -> None:
    """A loop that sees the truth is its own other with a watermark, too: its inputs are those with it, within their limits."""
    rng = np.random.default_rng(4)
    e, d = 0.5 * rng.standard_normal((SLOTS, 2, 2)), rng.uniform(0.0, 2.0, (SLOTS, 2))
    controller, state = CONTROLLERS["lqr"](GIVEN, 2), np.ones((2, 2))
    x, u = np.zeros(e.shape), np.zeros(e.shape)
    for k in range(SLOTS):
        x[k] = state
        u[k] = controller.decide(k, state, d[k]) if k % PERIOD == 0 else u[k - 1]
        state = A @ state + PLANT.moved(u[k] + e[k]) + (B_D @ d[k])[:, None]
    other = PerfectLoop(GIVEN.process, PLANT, CONTROLLERS["lqr"](GIVEN, 2), PERIOD, d)
    assert np.allclose(other.follow(x, u + e, e), PLANT.limited(u + e), atol=1e-10)
    assert PLANT.clips(u + e).any()


def test_a_loop_that_sees_the_truth_is_its_own_other() -> None:
    """Nothing differs, to the last bit."""
    rng = np.random.default_rng(2)
    noise, d = 0.05 * rng.standard_normal((SLOTS, 2, 2)), rng.uniform(0.0, 2.0, (SLOTS, 2))
    x, u = loop(noise, 0.0 * noise, d)
    other = PerfectLoop(GIVEN.process, PLANT, CONTROLLERS["lqr"](GIVEN, 2), PERIOD, d)
    assert np.array_equal(other.follow(x, u), u)


@pytest.mark.parametrize("sun", [0, None])
def test_who_knows_the_level_knows_the_load(sun: int | None) -> None:
    """With the true state, without noise, and the sun known or not there, the guess is each period's mean load."""
    rng = np.random.default_rng(3)
    d = rng.uniform(0.0, 2.0, (SLOTS, 2))
    d[:, 1] = np.repeat(rng.uniform(0.0, 2.0, SLOTS // PERIOD), PERIOD)
    d[:, 0] = np.repeat(d[::PERIOD, 0], PERIOD) if sun == 0 else 0.0
    nothing = np.zeros((SLOTS, 2, 2))
    x, _ = loop(nothing, nothing, d)
    guess = LoadGuess(GIVEN, CONTROLLERS["lqr"](GIVEN, 2), HousePlaces(0, 1, sun), d[:, 0])
    loads = [guess.take(k, x[k]) for k in range(0, SLOTS, PERIOD)]
    assert loads[0] is None
    for period, load in enumerate(loads[1:]):
        assert load is not None
        assert np.allclose(load, d[period * PERIOD, 1], atol=1e-9)


def test_what_is_not_known_is_taken_for_load() -> None:
    """A sun that the neighbour has no idea of makes the load less by as much; an error of the level, by its fraction."""
    d = np.tile([1.5, 0.5], (SLOTS, 1))
    nothing = np.zeros((SLOTS, 2, 1))
    straight = replace(GIVEN, process=Process(np.eye(2), GIVEN.process.Q, GIVEN.process.Q))
    x, u = np.zeros((SLOTS, 2, 1)), np.zeros((2, 1))
    controller = CONTROLLERS["lqr"](straight, 1)
    for k in range(SLOTS - 1):
        if k % PERIOD == 0:
            u = PLANT.limited(controller.decide(k, x[k], d[k]))
        x[k + 1] = x[k] + B @ u + (B_D @ d[k])[:, None] + nothing[k]
    blind = LoadGuess(straight, CONTROLLERS["lqr"](straight, 1), HousePlaces(0, 1, None), d[:, 0])
    loads = [blind.take(k, x[k]) for k in range(0, SLOTS, PERIOD)]
    for load in loads[1:]:
        assert load is not None
        assert np.allclose(load, -1.0)
    off = LoadGuess(straight, CONTROLLERS["lqr"](straight, 1), HousePlaces(0, 1, 0), d[:, 0])
    off.take(0, x[0])
    last = off.take(PERIOD, x[PERIOD] - np.array([[0.3], [0.0]]))
    assert last is not None
    assert np.allclose(last, 0.5 + 0.3 / (0.03 * PERIOD))
