"""Mixtures of normal distributions, one for every trial of a batch: pruning, merging and sums that no batch size changes.

Source: docs/mathematics.md, bayesian eavesdropper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.elementary import Floats
from evedrop.model.kernels.factored import Factors, covariance, orthogonalised

NEGLIGIBLE = 1e-12
"""The largest probability of a component that is dropped."""


class Mixture(NamedTuple):
    """Up to C components for every trial; a weight of 0 marks an empty place. A component keeps its place."""

    weight: Floats
    """(C, R); sums to 1 in every trial."""
    mean: Floats
    """(n, C, R)."""
    lower: Floats
    """The covariances' factors, (n (n−1)/2, C, R)."""
    diagonal: Floats
    """(n, C, R)."""

    @property
    def spread(self) -> Factors:
        """The covariances."""
        return Factors(self.lower, self.diagonal)


def summed(values: Floats) -> Floats:
    """Sum over components, (C, R) → (R,), one after the other, so that empty places change no bit."""
    total = np.zeros(values.shape[1:])
    for row in values:
        total += row
    return total


def pruned(of: Mixture) -> Mixture:
    """The mixture without negligible components, and without places that no trial needs."""
    weight = np.where(of.weight > NEGLIGIBLE, of.weight, 0.0)
    count = _places(weight)
    return Mixture(weight[:count], *(part[:, :count] for part in of[1:]))


def _places(weight: Floats) -> int:
    """The number of places up to the last that any trial uses."""
    used = np.flatnonzero(weight.any(axis=1))
    return int(used[-1]) + 1 if used.size else 0


def with_a_place(part: Floats, axis: int) -> Floats:
    """A part of a mixture with one more component, which is empty."""
    shape = list(part.shape)
    shape[axis] = 1
    return np.concatenate([part, np.zeros(shape)], axis=axis)


def merge(of: Mixture, trials: NDArray[np.intp]) -> None:
    """Merge the two least probable components of some trials, in place; the second place is then empty."""
    weight = of.weight[:, trials]
    weight = np.where(weight > 0.0, weight, np.inf)
    columns = np.arange(len(trials))
    first = np.argmin(weight, axis=0)
    without = weight.copy()
    without[first, columns] = np.inf
    second = np.argmin(without, axis=0)
    one, two = ((place, trials) for place in (first, second))
    total = of.weight[one] + of.weight[two]
    a, b = of.weight[one] / total, of.weight[two] / total
    apart = [m[two] - m[one] for m in of.mean]
    U, V = ([[*row] for row in Factors(of.lower[:, p, t], of.diagonal[:, p, t]).unit()] for p, t in (one, two))
    weights = [*(a * of.diagonal[(slice(None), *one)]), *(b * of.diagonal[(slice(None), *two)]), a * b]
    lower, diagonal = orthogonalised([u + v + [d] for u, v, d in zip(U, V, apart, strict=True)], weights)
    for m, d in zip(of.mean, apart, strict=True):
        m[one] += b * d
    of.lower[(slice(None), *one)], of.diagonal[(slice(None), *one)] = lower, diagonal
    of.weight[one], of.weight[two] = total, 0.0


def opened(of: Mixture, state: Floats, z: Floats, capacity: int) -> Mixture:
    """The mixture with a new component for each packet z (n, R), in the trial's first empty place, weighted by `state` (R,).

    Takes ownership of the arrays of `of`, which must not be used afterwards. Empty places have 0 everywhere.
    """
    new = np.flatnonzero(state > NEGLIGIBLE)
    free = of.weight[:, new] == 0.0
    full = new[~free.any(axis=0)]
    if full.size:
        if len(of.weight) < capacity:
            of = Mixture(*(with_a_place(part, part.ndim - 2) for part in of))
        else:
            merge(of, full)
        free = of.weight[:, new] == 0.0
    if new.size:
        place = np.argmax(free, axis=0)
        of.weight[place, new] = state[new]
        of.mean[:, place, new] = z[:, new]
        of.lower[:, place, new] = 0.0
        of.diagonal[:, place, new] = 0.0
    weight, there = np.zeros(of.weight.shape), of.weight != 0.0
    np.divide(of.weight, summed(of.weight), out=weight, where=there)
    weight = weight[: _places(weight)]
    return Mixture(weight, *(np.where(weight != 0.0, part[:, : len(weight)], 0.0) for part in of[1:]))


def moments(of: Mixture) -> tuple[Floats, Floats]:
    """Mean and covariance of every trial's mixture, (n, R) and (n, n, R)."""
    n, there = len(of.mean), of.weight != 0.0
    x_hat = np.stack([summed(of.weight * row) for row in of.mean])
    away, within = of.mean - x_hat[:, None, :], covariance(of.spread)
    P = np.empty((n, n, x_hat.shape[1]))
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = P[j, i] = summed(np.where(there, of.weight * (within[i, j] + away[i] * away[j]), 0.0))
    return x_hat, P
