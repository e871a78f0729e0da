"""Functions that give the same bits on every machine: only + − × ÷ √, comparisons and tables.

numpy's log and exp, LAPACK and BLAS depend on the processor and on the size of the batch; everything that enters a digest
uses these functions instead. All functions work elementwise, so a trial gives the same numbers alone and among a thousand.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SQRT_HALF = 0.7071067811865476
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
_LOG_ODD = (6.666666666666735130e-01, 2.857142874366239149e-01, 1.818357216161805012e-01, 1.479819860511658591e-01)
_LOG_EVEN = (3.999999999940941908e-01, 2.222219843214978396e-01, 1.531383769920937332e-01)


def sum_in_order(numbers: Iterable[float]) -> float:
    """The sum of numbers, added one after the other: the same bits with every Python, whose `sum` compensates since 3.12."""
    total = 0.0
    for number in numbers:
        total += number
    return total


def product(M: Floats, x: Floats) -> Floats:
    """M x of many vectors: M (…, m, n), x (…, n, R) → (…, m, R)."""
    y: Floats = M[..., :, 0, None] * x[..., None, 0, :]
    for j in range(1, M.shape[-1]):
        y += M[..., :, j, None] * x[..., None, j, :]
    return y


def polynomial(coefficients: Sequence[float], x: Floats) -> Floats:
    """Evaluate c₀ + c₁x + c₂x² + … by Horner's rule, elementwise (any shape)."""
    value: Floats = coefficients[-1] * x
    value += coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        value *= x
        value += coefficient
    return value


def log(x: Floats) -> Floats:
    """Natural logarithm of positive, finite, normal x, elementwise; error below one unit in the last place.

    Source: FreeBSD msun e_log.c (Sun Microsystems, 1993), its polynomial and its order of operations.
    """
    mantissa, exponent = np.frexp(x)
    small = mantissa < _SQRT_HALF
    mantissa = np.where(small, 2.0 * mantissa, mantissa)
    power = (exponent - small).astype(np.float64)
    f = mantissa - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    tail = w * polynomial(_LOG_EVEN, w) + z * polynomial(_LOG_ODD, w)
    half_square = 0.5 * f * f
    return power * _LN2_HIGH - ((half_square - (s * (half_square + tail) + power * _LN2_LOW)) - f)


_EXP = (
    1.66666666666666019037e-01,
    -2.77777777770155933842e-03,
    6.61375632143793436117e-05,
    -1.65339022054652515390e-06,
    4.13813679705723846039e-08,
)
_INVERSE_LN2 = 1.44269504088896338700e00
_EXP_LEAST, _EXP_MOST = -745.2, 709.78


def exp(x: Floats) -> Floats:
    """Exponential of finite x, elementwise; error below one unit in the last place, 0 below −745, inf above 709.78.

    Source: FreeBSD msun e_exp.c (Sun Microsystems, 1993), its polynomial and its order of operations.
    """
    within = np.clip(x, _EXP_LEAST, _EXP_MOST)
    power = np.rint(within * _INVERSE_LN2)
    high, low = within - power * _LN2_HIGH, power * _LN2_LOW
    r = high - low
    t = r * r
    c = r - t * polynomial(_EXP, t)
    value = np.ldexp(1.0 - ((low - (r * c) / (2.0 - c)) - high), power.astype(np.int64))
    return np.where(x < _EXP_LEAST, 0.0, np.where(x > _EXP_MOST, np.inf, value))


# Wichura (1988), "Algorithm AS 241: The percentage points of the normal distribution", PPND16.
_CENTRE = (
    (3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
     4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3),
    (1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
     2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3),
)  # fmt: skip
_TAIL = (
    (1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
     1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4),
    (1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1,
     1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9),
)  # fmt: skip
_FAR_TAIL = (
    (6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
     2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7),
    (1.0, 5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2,
     7.86869131145613259100e-4, 1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15),
)  # fmt: skip


def _tail_quantile(p: Floats) -> Floats:
    """Magnitude of the normal quantile for 0 < p < 0.075 (one dimension)."""
    r = np.sqrt(-log(p))
    near = r - 1.6
    value = polynomial(_TAIL[0], near) / polynomial(_TAIL[1], near)
    far = np.flatnonzero(r > 5.0)
    if far.size:
        beyond = r[far] - 5.0
        value[far] = polynomial(_FAR_TAIL[0], beyond) / polynomial(_FAR_TAIL[1], beyond)
    return value


def normal_quantile(u: Floats) -> Floats:
    """Inverse of the standard normal distribution function for 0 < u < 1, elementwise, relative error about 1e-16.

    Source: Wichura (1988), Applied Statistics 37(3), algorithm AS 241, PPND16.
    """
    q = u - 0.5
    r = 0.180625 - q * q
    value = polynomial(_CENTRE[0], r)
    value /= polynomial(_CENTRE[1], r)
    value *= q
    tails = np.flatnonzero(r < 0.0)
    if tails.size:
        flat_u, flat_value = u.reshape(-1), value.reshape(-1)
        upper = flat_u[tails] > 0.5
        magnitude = _tail_quantile(np.where(upper, 1.0 - flat_u[tails], flat_u[tails]))
        flat_value[tails] = np.where(upper, magnitude, -magnitude)
    return value


Rows = list[list[float]]


def cholesky(M: Floats) -> Floats:
    """Lower triangular L with L Lᵀ = M and a positive diagonal; M is (n, n), symmetric positive definite.

    Raises ValueError when M is not positive definite in double precision.
    """
    n = M.shape[0]
    rows: Rows = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = float(M[i, j])
            for c in range(j):
                rest -= rows[i][c] * rows[j][c]
            if i == j:
                if not rest > 0.0:
                    raise ValueError("not positive definite")
                rows[i][i] = math.sqrt(rest)
            else:
                rows[i][j] = rest / rows[j][j]
    return np.array(rows)


_NO_VARIANCE = 1e-12  # relative remainder of a diagonal entry that counts as rounding


def semidefinite_factor(M: Floats) -> Floats:
    """Lower triangular L with L Lᵀ = M, M (n, n) symmetric positive semidefinite; a direction without variance is a 0 column.

    Raises ValueError when M is not positive semidefinite.
    """
    n = M.shape[0]
    rows: Rows = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = float(M[i, j])
            for c in range(j):
                rest -= rows[i][c] * rows[j][c]
            scale = math.sqrt(abs(float(M[i, i]) * float(M[j, j])))
            if i == j:
                if rest < -_NO_VARIANCE * scale or (scale == 0.0 and rest != 0.0):
                    raise ValueError("not positive semidefinite")
                rows[i][i] = math.sqrt(rest) if rest > _NO_VARIANCE * scale else 0.0
            elif rows[j][j] > 0.0:
                rows[i][j] = rest / rows[j][j]
            elif abs(rest) > math.sqrt(_NO_VARIANCE) * scale:
                raise ValueError("not positive semidefinite")
    return np.array(rows)


def is_semidefinite(M: Floats) -> bool:
    """Whether M, (n, n) symmetric, is positive semidefinite, as a covariance is."""
    try:
        semidefinite_factor(M)
    except ValueError:
        return False
    return True


_SMALL, _SCALE = 2.0**-485, 2.0**600  # below the first, squares lose digits to underflow


def triangular_factor(rows: Rows) -> Rows:
    """Lower triangular L with L Lᵀ = M Mᵀ and a non-negative diagonal, for M (n, m) with m ≥ n, by Givens rotations.

    This is Rᵀ of the QR decomposition of Mᵀ, with its signs fixed. It never forms M Mᵀ, so it works where a Cholesky
    decomposition of the covariance fails. Plain Python floats: 4 µs for n = 2, and the same bits on every machine.

    Source: docs/mathematics/numerics.md, encoding noise.
    """
    work = [row[:] for row in rows]
    n, m = len(work), len(work[0])
    for i in range(n):
        pivot_row = work[i]
        for j in range(i + 1, m):
            b = pivot_row[j]
            if b == 0.0:
                continue
            a = pivot_row[i]
            r = math.sqrt(a * a + b * b)
            scale = _SCALE if r < _SMALL else 1.0
            if scale != 1.0:
                a, b = a * scale, b * scale
                r = math.sqrt(a * a + b * b)
            cosine, sine, r = a / r, b / r, r / scale
            pivot_row[i], pivot_row[j] = r, 0.0
            for row in work[i + 1 :]:
                left, right = row[i], row[j]
                row[i] = cosine * left + sine * right
                row[j] = cosine * right - sine * left
        if pivot_row[i] < 0.0:
            for row in work[i:]:
                row[i] = -row[i]
    return [row[:n] for row in work]


def has_settled(change: Floats, variances: Floats, within: float) -> bool:
    """Whether entry i, j of a change of a covariance, (n, n), is within this fraction of √(v_i v_j), v (n,), in any units."""
    deviations = np.sqrt(np.abs(variances))
    return bool(np.all(np.abs(change) <= within * deviations[:, None] * deviations))


def inverse(M: Floats) -> Floats:
    """Inverse of a nonsingular matrix (n, n), by elimination with row pivots.

    Raises ValueError where a pivot is 0.
    """
    n = M.shape[0]
    rows: Rows = [[*map(float, M[i]), *(1.0 if j == i else 0.0 for j in range(n))] for i in range(n)]
    for c in range(n):
        pivot = max(range(c, n), key=lambda i: abs(rows[i][c]))
        if rows[pivot][c] == 0.0:
            raise ValueError("singular")
        rows[c], rows[pivot] = rows[pivot], rows[c]
        divisor = rows[c][c]
        rows[c] = [value / divisor for value in rows[c]]
        for i in range(n):
            if i != c:
                factor = rows[i][c]
                rows[i] = [value - factor * other for value, other in zip(rows[i], rows[c], strict=True)]
    return np.array([row[n:] for row in rows])
