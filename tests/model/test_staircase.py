"""Coordinates in which directions without noise are exact zeros, and what double precision cannot decide."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.process import Process
from evedrop.model.staircase import Staircase, checked_slots
from evedrop.model.theory.leak import Leaks
from tests.examples import examples
from tests.model.singular_processes import PROCESSES, process_of

UNROUND = process_of([[1.0, 0.1, 0.0], [0.03, 0.9, 0.07], [0.0, 0.2, 1.1]], [[0.3], [0.1], [0.7]])


@pytest.mark.parametrize("case", [*PROCESSES, "of numbers that are not round"])
def test_directions_without_noise_are_zeros_to_the_bit(case: str) -> None:
    """The covariance m slots after a state has the rank of [G, A G, …], and 0 in all other rows: no rounding, in any slot."""
    process = PROCESSES.get(case, UNROUND)
    stairs = Staircase(process)
    A, P, reached = stairs.process.A, np.zeros((process.n, process.n)), np.zeros((process.n, 0))
    G = process.noise_factor
    for _ in range(process.n + 1):
        P, reached = A @ P @ A.T + stairs.process.Q, np.hstack([process.A @ reached, G])
        rank = int(np.linalg.matrix_rank(reached, tol=1e-9))
        zeros = process.n - rank
        assert not P[:zeros].any()
        assert np.linalg.eigvalsh(P[zeros:, zeros:]).min(initial=1.0) > 1e-6
    assert zeros == stairs.unreached
    assert stairs.later == process.n - int(np.linalg.matrix_rank(G))
    assert np.allclose(stairs.outward_covariance(stairs.process.Q[:, :, None])[:, :, 0], process.Q, atol=1e-15)
    x = np.random.default_rng(1).standard_normal((process.n, 5))
    assert np.allclose(stairs.outward(stairs.inward(x)), x, atol=1e-13)
    assert np.allclose(stairs.outward(A @ stairs.inward(x)), process.A @ x, atol=1e-12)
    many = np.random.default_rng(2).standard_normal((3, process.n, process.n, 4))
    rows = [stairs.outward_covariance(covariance) for covariance in many]
    assert np.array_equal(stairs.outward_covariance(many), rows)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(2, 5), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_units_of_the_states_do_not_matter(n: int, rank: int, seed: int) -> None:
    """The directions that noise reaches, and the probability of a type, are the same in metres and in millimetres."""
    random = np.random.default_rng(seed)
    A = np.round(random.standard_normal((n, n)) * 8.0) / 8.0 + 2.0 * np.eye(n)
    G = np.round(random.standard_normal((n, min(rank, n - 1))) * 8.0) / 8.0
    units = 2.0 ** random.integers(-20, 21, n)
    original = process_of(A.tolist(), G.tolist())
    other = Process(
        units[:, None] * A / units, units[:, None] * original.Q * units, np.diag(units * units), singular_noise=True
    )
    try:
        stairs = Staircase(original)
    except ValueError:
        return
    if not stairs.singular or np.linalg.cond(other.A) > 1e10:
        return
    again = Staircase(other)
    assert (again.unreached, again.later) == (stairs.unreached, stairs.later)
    assert np.allclose(again.process.A, stairs.process.A, rtol=1e-9, atol=1e-12)


def test_what_double_precision_cannot_decide_is_refused() -> None:
    """A singular A with a singular Q; a direction that noise may reach or not."""
    with pytest.raises(ValueError, match="A is singular to double precision, and so is Q"):
        Staircase(process_of([[1.0, 1.0], [1.0, 1.0]], [[0.0], [1.0]]))
    with pytest.raises(ValueError, match="cannot decide which states the noise of Q reaches"):
        # A g is g, but for a part of 1e-9.
        Staircase(process_of([[1.0, 2.0**-30], [0.0, 1.0]], [[1.0], [1.0]]))
    clear = Staircase(process_of([[1.0, 2.0**-30], [0.0, 1.0]], [[0.0], [1.0]]))
    assert (clear.unreached, clear.later) == (0, 1), "a small entry must not be taken for the rounding of a difference"
    nonsingular = Staircase(Process(np.eye(2), np.eye(2), np.eye(2), singular_noise=True))
    assert (nonsingular.singular, nonsingular.later) == (False, 0)
    assert not Leaks(nonsingular.process).rounding(range(1, 4)).any()
    assert nonsingular.outside(np.ones((2, 1))).shape == (0, 1)


def test_a_range_within_rounding_of_all_states_is_seen() -> None:
    """With a growing mode and one that noise never reaches, the reach of rounding becomes that of the states."""
    process = process_of([[2.0, 0.0], [0.0, 0.5]], [[1.0], [0.0]])
    near = process_of([[2.0, 0.0], [1.5, 0.5]], [[1.0], [1.0]])
    for model, blurred in ((process, False), (near, True)):
        leaks = Leaks(model)
        slots = [range(k, k + 1) for k in checked_slots(45)]
        blurs = [leaks.stairs.blurred(leaks.block(some)[:, :2, :2], leaks.rounding(some)) for some in slots]
        assert (blurs[0], any(blurs)) == (False, blurred)
    assert checked_slots(1) == []
    assert checked_slots(3) == [1, 2]
    assert checked_slots(300)[-3:] == [128, 256, 299]


def test_the_part_of_a_noise_outside_the_range_is_measured() -> None:
    """0 for the range of Q itself, and the fraction of a matrix that is outside this range."""
    stairs = Staircase(PROCESSES["sampled force"])
    G = PROCESSES["sampled force"].noise_factor[:, :1]
    assert stairs.outside(G).max() < 1e-15
    assert stairs.outside(np.array([[1.0], [0.0]])).max() == pytest.approx(1.0)
    assert not stairs.outside(np.zeros((2, 1))).any()
