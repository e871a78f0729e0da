"""Factors X of error covariances X Xᵀ, one for each trial, and systems of equations with triangular ones."""

from __future__ import annotations

import numpy as np

from evedrop.model.process import Floats, product


def triangular_solutions(L: Floats, z: Floats) -> Floats:
    """L⁻¹ z of many triangular matrices (R, n, n) and vectors (n, R); 0 where a row has no variance."""
    y = np.zeros_like(z)
    for i in range(len(z)):
        rest = z[i]
        for j in range(i):
            rest = rest - L[:, i, j] * y[j]
        pivot = L[:, i, i]
        y[i] = np.where(pivot > 0.0, rest / np.where(pivot > 0.0, pivot, 1.0), 0.0)
    return y


def squares(X: Floats) -> Floats:
    """X Xᵀ of every trial, (n, n, R)."""
    factors = X.transpose(2, 0, 1).copy()
    found: Floats = product(factors, factors.swapaxes(1, 2).copy()).transpose(1, 2, 0)
    return found
