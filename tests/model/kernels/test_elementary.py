"""Elementary functions, against Python's, scipy's and LAPACK's, and against themselves one number at a time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtri

from evedrop.model.kernels.elementary import cholesky, exp, inverse, log, normal_quantile, polynomial, triangular_factor

POSITIVE = st.floats(min_value=2.3e-308, max_value=1.7e308, allow_subnormal=False)
PROBABILITIES = st.integers(1, 2**53 - 1).map(lambda i: i * 2.0**-53)
ENTRIES = st.floats(-10, 10, allow_subnormal=False).map(lambda v: round(v, 6))


@settings(deadline=None)
@given(st.lists(POSITIVE, min_size=1, max_size=50))
def test_log_is_within_one_unit_in_the_last_place(x: list[float]) -> None:
    """The logarithm is math.log's to one unit in the last place."""
    for actual, expected in zip(log(np.array(x)).tolist(), map(math.log, x), strict=True):
        assert abs(actual - expected) <= math.ulp(expected)


def test_log_at_landmarks() -> None:
    """Exact at 1, near 1 without cancellation, and across every change of exponent."""
    assert log(np.array([1.0]))[0] == 0.0
    near = 1.0 + np.arange(-1000, 1000, dtype=np.float64) * 2.0**-45
    assert np.allclose(log(near), np.log1p(near - 1.0), rtol=3e-16, atol=0)
    powers = np.array(
        [math.ldexp(m, e) for e in range(-1000, 1000, 7) for m in (0.5, 0.7071067811865475, 0.7071067811865477)]
    )
    expected = np.array([math.log(x) for x in powers.tolist()])
    assert np.all(np.abs(log(powers) - expected) <= np.spacing(np.abs(expected)))


@settings(deadline=None)
@given(st.lists(st.floats(-745.0, 709.7), min_size=1, max_size=50))
def test_exp_is_within_one_unit_in_the_last_place(x: list[float]) -> None:
    """The exponential is math.exp's to one unit in the last place, subnormal results too."""
    for actual, expected in zip(exp(np.array(x)).tolist(), map(math.exp, x), strict=True):
        assert abs(actual - expected) <= math.ulp(expected)


def test_exp_at_landmarks() -> None:
    """Exact at 0, right on both sides of every change of exponent, 0 and inf where nothing else is left."""
    assert exp(np.array([0.0, -0.0, -800.0, -np.inf, 710.0, np.inf])).tolist() == [1.0, 1.0, 0.0, 0.0, np.inf, np.inf]
    halves = np.arange(-1000, 1000) * (0.5 * math.log(2.0))
    x = np.concatenate([halves, np.nextafter(halves, np.inf), np.nextafter(halves, -np.inf)])
    expected = np.array([math.exp(value) for value in x.tolist()])
    assert np.all(np.abs(exp(x) - expected) <= np.spacing(expected))


@settings(deadline=None)
@given(st.lists(PROBABILITIES, min_size=1, max_size=50))
def test_quantile_is_scipys(u: list[float]) -> None:
    """The normal quantile agrees with scipy's to 1e-14, relatively."""
    result, expected = normal_quantile(np.array(u)), ndtri(np.array(u))
    assert np.allclose(result, expected, rtol=1e-14, atol=1e-15)


def test_quantile_in_every_region() -> None:
    """A fine grid through centre, tails and far tails: 1e-14 of scipy, rising, and odd about one half."""
    u = np.concatenate([np.linspace(1e-6, 0.5, 100_000), 2.0 ** -np.arange(2, 54.0)])
    result = normal_quantile(u)
    assert np.allclose(result, ndtri(u), rtol=1e-14, atol=1e-15)
    order = np.argsort(u)
    assert np.all(np.diff(result[order]) >= 0)
    dyadic = np.arange(1, 2**12) / 2**13
    assert np.array_equal(normal_quantile(1.0 - dyadic), -normal_quantile(dyadic))


@settings(deadline=None)
@given(st.lists(PROBABILITIES, min_size=2, max_size=40), st.data())
def test_a_number_alone_has_the_same_bits(u: list[float], data: st.DataObject) -> None:
    """Alone, among others and in any shape, a number's logarithm, exponential and quantile are the same bits."""
    i = data.draw(st.integers(0, len(u) - 1))
    for function in (log, exp, normal_quantile):
        among = function(np.array(u))
        assert function(np.array([u[i]])).tobytes() == among[i : i + 1].tobytes()
        square = function(np.tile(np.array(u), (3, 1)))
        assert square[1].tobytes() == among.tobytes()


def test_polynomial_is_horners_rule() -> None:
    """Coefficients rise with the power."""
    assert polynomial((1.0, 2.0, 3.0), np.array([0.0, 2.0, -1.0])).tolist() == [1.0, 17.0, 2.0]


@st.composite
def wide_matrices(draw: st.DrawFn) -> np.ndarray:
    """N × m matrices with m ≥ n, zeros among the entries."""
    n = draw(st.integers(1, 5))
    m = draw(st.integers(n, 2 * n))
    rows = draw(st.lists(st.lists(st.one_of(ENTRIES, st.just(0.0)), min_size=m, max_size=m), min_size=n, max_size=n))
    return np.array(rows)


@settings(deadline=None)
@given(wide_matrices())
def test_triangular_factor_is_one(M: np.ndarray) -> None:
    """L is lower triangular with a diagonal that is not negative, and L Lᵀ = M Mᵀ to rounding."""
    n = len(M)
    L = np.array(triangular_factor(M.tolist()))
    assert np.array_equal(L, np.tril(L))
    assert np.all(np.diag(L) >= 0)
    assert np.allclose(L @ L.T, M @ M.T, rtol=1e-12, atol=1e-12 * max(1.0, float(np.abs(M).max()) ** 2))
    assert L.shape == (n, n)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_triangular_factor_is_lapacks(n: int) -> None:
    """For well-conditioned M it is numpy's QR with columns signed, and Cholesky of M Mᵀ, to 1e-12."""
    rng = np.random.default_rng(n)
    for _ in range(50):
        M = rng.standard_normal((n, 2 * n))
        L = np.array(triangular_factor(M.tolist()))
        R = np.linalg.qr(M.T, mode="r")
        assert np.allclose(L, (R * np.sign(np.diag(R))[:, None]).T, rtol=0, atol=1e-12)
        assert np.allclose(L, np.linalg.cholesky(M @ M.T), rtol=0, atol=1e-10)


@pytest.mark.parametrize("small", [1e-140, 1e-147, 3e-162, 1e-170, 1e-300, 5e-324])
def test_triangular_factor_of_a_row_whose_squares_underflow(small: float) -> None:
    """The rotation stays a rotation: the other rows, of size 1, keep their products."""
    M = np.array([[3.0 * small, 0.0, 4.0 * small, 0.0], [0.2, 0.5, -0.9, 1.1]])
    L = np.array(triangular_factor(M.tolist()))
    assert L[0] == pytest.approx([5.0 * small, 0.0], rel=1e-14, abs=0.0)
    assert L[1, 0] == pytest.approx((3.0 * 0.2 - 4.0 * 0.9) / 5.0, rel=1e-14)
    assert L[1] @ L[1] == pytest.approx(M[1] @ M[1], rel=1e-14)


def test_triangular_factor_leaves_its_argument_alone() -> None:
    """The rows that are given are not changed."""
    rows = [[1.0, 2.0], [3.0, 4.0]]
    triangular_factor(rows)
    assert rows == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_cholesky_is_numpys(n: int) -> None:
    """The Cholesky factor agrees with numpy's to 1e-12."""
    rng = np.random.default_rng(n)
    for _ in range(50):
        M = rng.standard_normal((n, n))
        P = M @ M.T + 0.1 * np.eye(n)
        assert np.allclose(cholesky(P), np.linalg.cholesky(P), rtol=0, atol=1e-12)


@pytest.mark.parametrize("M", [[[0.0]], [[-1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[math.nan]]])
def test_cholesky_refuses_what_is_not_positive_definite(M: list[list[float]]) -> None:
    """Indefinite, singular and undefined matrices are errors, not NaN."""
    with pytest.raises(ValueError, match="not positive definite"):
        cholesky(np.array(M))


@settings(deadline=None)
@given(st.integers(1, 4), st.integers(0, 2**31))
def test_inverse_is_the_inverse(n: int, seed: int) -> None:
    """It is LAPACK's to the condition of the matrix, zero pivots on the way included; singular matrices are refused."""
    M = np.random.default_rng(seed).integers(-2, 3, (n, n)).astype(float)
    if abs(np.linalg.det(M)) > 0.5:
        assert np.allclose(inverse(M), np.linalg.inv(M), rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="singular"):
        inverse(np.zeros((n, n)))
