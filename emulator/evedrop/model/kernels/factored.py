"""Covariances as U D Uᵀ, U lower triangular with a unit diagonal: many at a time, with only + − × ÷.

With a process that grows as ρ^k, the eigenvalues of a covariance are as far apart as ρ^{2k}, and it soon cannot be factored
any more. Its factors can be propagated instead, because their small entries stay accurate.

Source: Thornton (1976), weighted Gram-Schmidt; docs/mathematics/eavesdroppers.md, bayesian eavesdropper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evedrop.model.kernels.elementary import Floats, Rows

Entry = Floats | float
"""An entry of many matrices at once, or the same number in all of them."""


class Factor(NamedTuple):
    """U D Uᵀ of one matrix, in plain numbers."""

    unit: Rows
    """U, (n, n)."""
    diagonal: list[float]
    """D, (n,), none negative."""

    @classmethod
    def of_triangular(cls, L: Rows) -> Factor:
        """The factor of L Lᵀ, L lower triangular with a non-negative diagonal."""
        n = len(L)
        unit = [[L[i][j] / L[j][j] if L[j][j] > 0.0 else 0.0 for j in range(i)] for i in range(n)]
        return cls(
            [[*row, 1.0] + [0.0] * (n - 1 - i) for i, row in enumerate(unit)], [L[i][i] * L[i][i] for i in range(n)]
        )


class Factors(NamedTuple):
    """U D Uᵀ of many matrices, in a batch of any shape S."""

    lower: Floats
    """U below its diagonal, row by row, (n (n−1)/2, S)."""
    diagonal: Floats
    """D, (n, S)."""

    @classmethod
    def alike(cls, factor: Factor, shape: tuple[int, ...]) -> Factors:
        """The factors of equal matrices."""

        def repeated(values: list[float]) -> Floats:
            column = np.array(values).reshape(-1, *(1 for _ in shape))
            return np.broadcast_to(column, (len(values), *shape)).copy()

        return cls(
            repeated([value for i, row in enumerate(factor.unit) for value in row[:i]]), repeated(factor.diagonal)
        )

    def rounded(self, rounding: Floats) -> Factors:
        """The same with D of at least rounding (n,)."""
        least = rounding.reshape(-1, *(1 for _ in self.diagonal.shape[1:]))
        return Factors(self.lower, np.where(self.diagonal > least, self.diagonal, least))

    def unit(self) -> list[list[Entry]]:
        """U as rows of entries."""
        n = len(self.diagonal)
        starts = [i * (i - 1) // 2 for i in range(n)]
        return [[*self.lower[start : start + i], 1.0] + [0.0] * (n - 1 - i) for i, start in enumerate(starts)]


def solved(L: Sequence[Sequence[float]], z: Floats) -> Floats:
    """L⁻¹ z of many vectors, by forward substitution: L lower triangular, n rows of n; z and the result (n, R)."""
    y = np.empty_like(z)
    for i, row in enumerate(L):
        rest = z[i]
        for j in range(i):
            rest = rest - row[j] * y[j]
        y[i] = rest / row[i]
    return y


def grown(A: Floats, P: Factors, *noises: Factor) -> list[Factors]:
    """Factors of A P Aᵀ + noise for each of the noises; A (n, n)."""
    U = P.unit()
    carried = [[_dot(a, [row[j] for row in U]) for j in range(len(a))] for a in A.tolist()]
    weighted = [_times(D, value) for D, value in zip(P.diagonal, carried[0], strict=True)]
    products = [_dot(weighted, row) for row in carried]
    results = []
    for noise in noises:
        rows = [[*left, *right] for left, right in zip(carried, noise.unit, strict=True)]
        own = [noise.diagonal[0] * row[0] for row in noise.unit]  # in U's first row only the first entry is not 0
        first = [left + right for left, right in zip(products, own, strict=True)]
        results.append(orthogonalised(rows, [*P.diagonal, *noise.diagonal], first))
    return results


def orthogonalised(
    rows: Sequence[list[Entry]], weights: Sequence[Entry], first: Sequence[Entry] | None = None
) -> Factors:
    """Factors of W diag(weights) Wᵀ, from the rows of W, (n, m), and m non-negative weights.

    Weighted Gram-Schmidt on the rows avoids matrices whose eigenvalues are further apart than those of the factors. The
    first weight must have the batch's shape. first: the products of the first row with all rows, if known.
    """
    work = list(rows)
    n, shape = len(work), np.shape(weights[0])
    lower = np.empty((n * (n - 1) // 2, *shape))
    diagonal = np.empty((n, *shape))
    for i in range(n):
        products = first
        if products is None or i:
            weighted = [_times(weight, value) for weight, value in zip(weights, work[i], strict=True)]
            products = [_dot(weighted, row) for row in work[i:]]
        length = diagonal[i] = products[0]
        for j, along in enumerate(products[1:], i + 1):
            share = np.zeros(shape)
            np.divide(along, length, out=share, where=length > 0.0)
            lower[j * (j - 1) // 2 + i] = share
            work[j] = [right - _times(share, left) for left, right in zip(work[i], work[j], strict=True)]
    return Factors(lower, diagonal)


def _times(a: Entry, b: Entry) -> Entry:
    """The product of two entries; an entry that is 0 or 1 in all matrices costs nothing."""
    for first, second in ((a, b), (b, a)):
        if isinstance(first, float) and first in {0.0, 1.0}:
            return second if first else 0.0
    return a * b


def _dot(left: Sequence[Entry], right: Sequence[Entry]) -> Entry:
    """Sum of products, skipping those that are 0 in all matrices."""
    total: Entry = 0.0
    ours = False  # `_times` may return one of its arguments
    for a, b in zip(left, right, strict=True):
        term = _times(a, b)
        if isinstance(total, float) and total == 0.0:
            total = term
        elif not (isinstance(term, float) and term == 0.0):
            if ours and isinstance(total, np.ndarray):
                total += term
            else:
                total, ours = total + term, True
    return total


def whitened(P: Factors, d: Sequence[Floats] | Floats) -> list[Floats]:
    """U⁻¹ d of d, n arrays of the batch's shape."""
    e: list[Floats] = []
    for row, value in zip(P.unit(), d, strict=True):
        rest = value
        for factor, earlier in zip(row, e, strict=False):
            rest = rest - factor * earlier
        e.append(rest)
    return e


def squared_length(P: Factors, d: Sequence[Floats] | Floats) -> Floats:
    """dᵀ P⁻¹ d of d, n arrays of the batch's shape; P positive definite."""
    total: Entry = 0.0
    for rest, D in zip(whitened(P, d), P.diagonal, strict=True):
        total = total + rest * rest / D
    return np.asarray(total)


def parts_of_joint(joint: Factors) -> tuple[Factors, list[list[Floats]], Factors]:
    """The factors of (2n, 2n) matrices in parts: those of the first block, the block of U below it, those of the remainder."""
    n = len(joint.diagonal) // 2
    starts = [i * (i - 1) // 2 for i in range(2 * n)]
    below = [list(joint.lower[start : start + n]) for start in starts[n:]]
    last = [joint.lower[start + n : start + n + i] for i, start in enumerate(starts[n:])]
    return (
        Factors(joint.lower[: starts[n]], joint.diagonal[:n]),
        below,
        Factors(np.concatenate(last), joint.diagonal[n:]),
    )


def covariance(P: Factors) -> Floats:
    """P itself, (n, n, S)."""
    U, n = P.unit(), len(P.diagonal)
    result = np.empty((n, n, *P.diagonal.shape[1:]))
    for j in range(n):
        weighted = [_times(d, value) for d, value in zip(P.diagonal, U[j], strict=True)]
        for i in range(j, n):
            result[i, j] = result[j, i] = _dot(weighted[: j + 1], U[i][: j + 1])
    return result
