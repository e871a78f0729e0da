"""The process: its products, its checks, its simulation, its covariances and how far float64 carries it."""

from __future__ import annotations

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.process import MOST_STATES, Floats, Process, StateFactors, Trajectory, mistakes_of, product
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.model.theory.covariances import state_covariances
from evedrop.model.theory.horizon import horizon
from tests.builders import DRIFTING, UNSTABLE

KEY = stream_key(root_of_seed(1), "process")


@pytest.mark.parametrize(("initial", "last"), [(1.0, 87), (1e-3, 96), (1e-12, 97)])
def test_horizon_of_the_papers_example(initial: float, last: int) -> None:
    """The last slot within float64's reach: 87 for Σ0 = I, 96 for Σ0 = Q, 97 for 1e-12 I."""
    process = Process(UNSTABLE.A, UNSTABLE.Q, initial * np.eye(2))
    assert horizon(process, 200) == last
    assert horizon(process, 100_000) == last
    assert horizon(process, last + 2) == last
    assert horizon(process, last + 1) is None


def test_horizon_of_a_marginally_stable_process() -> None:
    """The microgrid's day is within reach."""
    assert horizon(Process(np.eye(2), 1e-5 * np.eye(2), 1e-5 * np.eye(2)), 86_400) is None


def test_horizon_beyond_all_numbers() -> None:
    """A process that overflows within the run has its horizon all the same, without a warning."""
    assert 0 < (horizon(Process(10.0 * np.eye(1), np.eye(1), np.eye(1)), 5000) or 0) < 20


@settings(deadline=None)
@given(st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**31))
def test_products_are_numpys(n: int, trials: int, seed: int) -> None:
    """A x, A P Aᵀ and M x are numpy's to rounding, for every trial and in stacks."""
    rng = np.random.default_rng(seed)
    M, x, P = rng.standard_normal((n, n)), rng.standard_normal((n, trials)), rng.standard_normal((n, n, trials))
    process = Process(M, np.eye(n), np.eye(n))
    assert np.allclose(process.predict(x), M @ x, rtol=1e-12, atol=1e-12)
    assert np.allclose(process.carry(P), np.einsum("ij,jkr,lk->ilr", M, P, M), rtol=1e-12, atol=1e-12)
    assert np.array_equal(process.diffuse(P), P + np.eye(n)[:, :, None])
    stack = rng.standard_normal((3, n, trials))
    assert np.allclose(
        product(np.stack([M, 2 * M, -M]), stack), np.stack([M, 2 * M, -M]) @ stack, rtol=1e-12, atol=1e-12
    )


@settings(deadline=None)
@given(st.integers(1, 4), st.integers(2, 40), st.integers(0, 2**31), st.data())
def test_products_do_not_depend_on_the_batch(n: int, trials: int, seed: int, data: st.DataObject) -> None:
    """A trial's bits are the same alone and among others."""
    rng = np.random.default_rng(seed)
    process = Process(rng.standard_normal((n, n)), np.eye(n), np.eye(n))
    x, P = rng.standard_normal((n, trials)), rng.standard_normal((n, n, trials))
    r = data.draw(st.integers(0, trials - 1))
    part = slice(r, r + 1)
    assert process.predict(x[:, part].copy()).tobytes() == process.predict(x)[:, part].tobytes()
    assert process.carry(P[:, :, part].copy()).tobytes() == process.carry(P)[:, :, part].tobytes()


def states(process: Process, batch: Batch) -> np.ndarray:
    """All states, (slots, n, R)."""
    trajectory = Trajectory(process, KEY, batch)
    return np.stack([trajectory.advance().copy() for _ in range(batch.slots)])


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
def test_a_trial_alone_is_the_same_trial(process: Process) -> None:
    """Trial 1003 alone, among 7 and among 500 is the same to the bit, and so are fewer slots."""
    among = states(process, Batch(60, 500, 900))
    assert states(process, Batch(60, 1, 1003)).tobytes() == np.ascontiguousarray(among[:, :, 103:104]).tobytes()
    assert states(process, Batch(60, 7, 1000)).tobytes() == np.ascontiguousarray(among[:, :, 100:107]).tobytes()
    assert np.array_equal(states(process, Batch(10, 500, 900)), among[:10])


def test_states_follow_the_process() -> None:
    """x⁺ − A x is white noise of covariance Q, and x_0 has Σ0: chi-squared over 20 000 trials at 1e-6 confidence."""
    trajectory = Trajectory(DRIFTING, KEY, Batch(4, 20_000))
    before = np.zeros((3, 20_000))
    for k in range(4):
        x = trajectory.advance().copy()
        if k:
            assert np.allclose(trajectory.predicted, DRIFTING.A @ before, rtol=1e-12, atol=1e-13)
        w = x - (DRIFTING.A @ before if k else 0.0)
        white = np.linalg.solve(np.linalg.cholesky(DRIFTING.Q if k else DRIFTING.initial_covariance), w)
        distance = np.sum(white * white)
        assert 1e-6 < stats.chi2.cdf(distance, white.size) < 1 - 1e-6
        assert stats.kstest(white.ravel(), "norm").pvalue > 1e-6
        before = x


def test_covariances_are_the_recursion() -> None:
    """Σ_k = A Σ_{k−1} Aᵀ + Q from Σ0, in closed form."""
    result = state_covariances(DRIFTING, 20)
    for k in (0, 1, 7, 19):
        power = np.linalg.matrix_power
        expected = power(DRIFTING.A, k) @ DRIFTING.initial_covariance @ power(DRIFTING.A, k).T
        expected += sum(
            (power(DRIFTING.A, j) @ DRIFTING.Q @ power(DRIFTING.A, j).T for j in range(k)), np.zeros((3, 3))
        )
        assert np.allclose(result[k], expected, rtol=1e-12)


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
def test_factors_are_of_the_covariances(process: Process) -> None:
    """A L_{k−1} times its transpose is A Σ_{k−1} Aᵀ, to 1e-12, whatever the order in which slots are asked for."""
    factors = StateFactors(process)
    covariances = state_covariances(process, 30)
    for k in (1, 2, 3, 29, 5, 1, 12):
        F = factors.block(range(k, k + 1))[0]
        expected = process.A @ covariances[k - 1] @ process.A.T
        assert np.allclose(F @ F.T, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        assert np.array_equal(F, StateFactors(process).block(range(k, k + 1))[0])
    for slots in (range(3), range(3, 12), range(4, 6), range(20, 30), range(1)):
        block = factors.block(slots)
        for row, k in enumerate(slots):
            assert np.array_equal(
                block[row], StateFactors(process).block(range(k, k + 1))[0] if k else np.zeros(process.A.shape)
            )


def test_factors_hold_where_cholesky_fails() -> None:
    """In the unstable example they hold at k = 60 against exact fractions, where Σ has no Cholesky factor any more."""
    exact = [[Fraction(float(v)) for v in row] for row in UNSTABLE.initial_covariance]
    A_, Q_ = ([[Fraction(float(v)) for v in row] for row in M] for M in (UNSTABLE.A, UNSTABLE.Q))

    def times(M: list[list[Fraction]], N: list[list[Fraction]]) -> list[list[Fraction]]:
        return [[sum((M[i][j] * N[j][c] for j in range(2)), Fraction(0)) for c in range(2)] for i in range(2)]

    transposed = [list(row) for row in zip(*A_, strict=True)]
    for k in range(1, 61):
        exact = times(times(A_, exact), transposed)
        if k < 60:
            exact = [[exact[i][j] + Q_[i][j] for j in range(2)] for i in range(2)]
    F = [[Fraction(v) for v in row] for row in StateFactors(UNSTABLE).block(range(60, 61))[0].tolist()]
    result = times(F, [list(row) for row in zip(*F, strict=True)])
    for i in range(2):
        for j in range(2):
            assert abs(result[i][j] / exact[i][j] - 1) < Fraction(1, 10**13)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(state_covariances(UNSTABLE, 60)[-1] - UNSTABLE.Q)


def test_spectral_radius_of_the_example() -> None:
    """ρ(A) = 1.387799, the paper's."""
    assert abs(UNSTABLE.spectral_radius - 1.387799) < 5e-7


MISTAKES = {
    "rectangular A": ([[1.0, 0.0]], [[1.0]], [[1.0]], "A", "square"),
    "Q of another size": (np.eye(2), [[1.0]], np.eye(2), "Q", "2 × 2"),
    "infinite A": ([[np.inf]], [[1.0]], [[1.0]], "A", r"\[0\]\[0\] is inf"),
    "asymmetric Q": (np.eye(2), [[1.0, 0.1], [0.0, 1.0]], np.eye(2), "Q", "symmetric"),
    "indefinite Σ0": (np.eye(2), np.eye(2), [[1.0, 2.0], [2.0, 1.0]], "initial_covariance", "positive definite"),
    "singular Q": (np.eye(2), [[1.0, 1.0], [1.0, 1.0]], np.eye(2), "Q", "positive definite"),
    "too small a Q": (np.eye(2), 1e-200 * np.eye(2), np.eye(2), "Q", "variance 1e-200"),
    "too large a Σ0": (np.eye(2), np.eye(2), np.diag([1.0, 1e154]), "initial_covariance", r"from 1e-100 to 1e[+]100"),
    "uncontrollable": (np.eye(2), [[1.0, 0.0], [0.0, 0.0]], np.eye(2), "Q", "controllable"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(name: str) -> None:
    """The reason why matrices are not a process is given for the right entry."""
    *matrices, entry, sentence = MISTAKES[name]
    A, Q, initial = (np.array(M, float) for M in matrices)
    mistakes = mistakes_of(A, Q, initial)
    assert any(where == entry and re.search(sentence, reason) for where, reason in mistakes), mistakes


@pytest.mark.parametrize("process", [UNSTABLE, DRIFTING])
def test_a_process_has_no_mistakes(process: Process) -> None:
    """The examples pass."""
    assert mistakes_of(process.A, process.Q, process.initial_covariance) == []


@pytest.mark.parametrize("scale", [1e-100, 1e100])
def test_units_of_the_states_may_be_far_apart(scale: float) -> None:
    """The largest variance counts."""
    assert mistakes_of(np.eye(2), np.diag([scale, 1e-5 * scale]), scale * np.eye(2)) == []


def test_a_process_of_too_many_states_is_refused() -> None:
    """Before anything is computed of it."""
    ((entry, sentence),) = mistakes_of(np.eye(MOST_STATES + 1), np.eye(2), np.eye(2))
    assert entry == "A"
    assert sentence.startswith(f"has {MOST_STATES + 1} rows; expected at most {MOST_STATES} states")


@pytest.mark.parametrize("A", [np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2)])
def test_a_singular_Q_is_refused_with_the_entry_that_allows_it(A: Floats) -> None:
    """The Q of a double integrator gets a hint; no entry allows a Q with a negative eigenvalue."""
    Q = np.diag([0.0, 0.01])
    mistakes = mistakes_of(A, Q, np.eye(2))
    assert mistakes
    assert all(entry == "Q" and "; or singular_noise = true" in sentence for entry, sentence in mistakes)
    assert mistakes_of(A, Q, np.eye(2), singular_noise=True) == []
    assert "singular_noise" not in str(mistakes_of(A, -Q, np.eye(2)))


def test_noise_that_may_be_singular_is_still_a_covariance() -> None:
    """Of rank one it is accepted, with a negative eigenvalue it is not."""
    assert mistakes_of(np.eye(2), np.ones((2, 2)), np.eye(2), singular_noise=True) == []
    assert mistakes_of(np.eye(2), np.diag([1.0, -1.0]), np.eye(2), singular_noise=True) == [
        ("Q", "has an eigenvalue below 0; expected a covariance")
    ]


def slot_by_slot(process: Process, slots: int) -> int | None:
    """The horizon by its definition."""
    limit = (0.01 * 2.0**53) ** 2 * float(np.linalg.eigvalsh(process.Q)[0])
    sigma = process.initial_covariance
    for k in range(slots):
        if np.linalg.eigvalsh(sigma)[-1] > limit:
            return k - 1
        sigma = process.A @ sigma @ process.A.T + process.Q
    return None


ROTATION = np.array([[0.6, -0.8], [0.8, 0.6]])


@pytest.mark.parametrize(
    ("process", "slots"),
    [
        (UNSTABLE, 500),
        (UNSTABLE, 20),
        (Process(0.5 * np.eye(2), np.eye(2), np.eye(2)), 10**8),
        (Process(1.001 * ROTATION, np.diag([1e-20, 1.0]), 1e-3 * np.eye(2)), 5000),
        (Process(np.array([[1.0, 0.0], [0.0, 1.2]]), np.diag([1.0, 1.0]), np.diag([3e27, 3e27])), 200),
    ],
    ids=["unstable", "short", "stable", "slow", "close"],
)
def test_the_horizon_is_the_last_slot_within_reach(process: Process, slots: int) -> None:
    """By its definition, slot by slot; a covariance that no longer changes has no horizon."""
    expected = None if process.spectral_radius < 1.0 else slot_by_slot(process, slots)
    assert horizon(process, slots) == expected


def test_the_horizon_of_a_long_run_is_bisected() -> None:
    """A random walk has Σ_k = 1 + k: it is within reach until k + 1 exceeds (0.01 · 2⁵³)² q."""
    q = 1e-20
    walk = Process(np.eye(1), np.array([[q]]), np.array([[1e-3]]))
    limit = (0.01 * 2.0**53) ** 2 * q
    assert slot_by_slot(walk, 2) is None
    assert horizon(walk, 10**7) is None
    grows = Process(np.array([[1.000001]]), np.array([[1.0]]), np.array([[1.0]]))
    result = horizon(grows, 10**8)
    # Σ_k = a^2k + (a^2k − 1)/(a² − 1)
    a2 = 1.000001**2
    expected = np.log(((0.01 * 2.0**53) ** 2 * (a2 - 1) + 1) / a2) / np.log(a2)
    assert result is not None
    assert result > 4 * 2**20
    assert abs(result - expected) < 2 + 1e-6 * expected
    assert limit > 1.0
