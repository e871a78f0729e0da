"""Mixtures of normal distributions, one for every trial of a batch: pruning, merging and sums that no batch size changes.

Source: docs/mathematics.md, bayesian eavesdropper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evedrop.model.numeric.factored import Factors, orthogonalised
from evedrop.model.process import Floats

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
    used = np.flatnonzero(weight.any(axis=1))
    count = int(used[-1]) + 1 if used.size else 0
    return Mixture(weight[:count], *(part[:, :count] for part in of[1:]))


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
