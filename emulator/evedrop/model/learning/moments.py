"""Weighted moments of transitions (x_{k−1}, x_k), and the A, Q and μ_d that they make most likely.

The regression's information is carried in factors, because with an unstable A its eigenvalues are soon as far apart as ρ^{2k}.
Moments with x_k are those of x_k − A x_{k−1} with the A of the time, so that nothing large cancels.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evedrop.model.kernels.elementary import Floats
from evedrop.model.kernels.factored import Factors, covariance, orthogonalised
from evedrop.model.kernels.mixtures import summed
from evedrop.model.learning.posterior import Parameters, Transition

RIDGE = 1e-3
"""Weight of the imagined transition that makes the regression nonsingular."""
_LEAST = 1e-9  # least D in the factors of Q, over the variance of the first packets
_LARGEST = 1e6  # largest entry of A


class Moments(NamedTuple):
    """Sums over the transitions of R trials, each with its probability r as weight."""

    lower: Floats
    """Factors of Σ r E x_{k−1} x_{k−1}ᵀ, (n (n−1)/2, R)."""
    diagonal: Floats
    """(n, R)."""
    cross: Floats
    """Σ r E (x_k − A x_{k−1}) x_{k−1}ᵀ, (n, n, R)."""
    square: Floats
    """Σ r E (x_k − A x_{k−1})(x_k − A x_{k−1})ᵀ, (n, n, R)."""
    transitions: Floats
    """Σ r, (R,)."""
    states: Floats
    """Packets that were the state, (R,)."""
    packets: Floats
    """All packets, (R,)."""

    @classmethod
    def imagined(cls, A: Floats, scale: Floats, ridge: float = RIDGE) -> Moments:
        """Those of one transition of little weight, in which the state stays, and of one packet of each type.

        A (n, n, R); scale: the variance of the first packets, (R,); ridge: the transition's weight.
        """
        n, _, trials = A.shape
        weight, away = ridge * scale, np.eye(n)[:, :, None] - A
        return cls(
            np.zeros((n * (n - 1) // 2, trials)),
            np.repeat(weight[None], n, axis=0),
            weight * away,
            weight * outer(away, away),
            np.zeros(trials),
            np.ones(trials),
            np.full(trials, 2.0),
        )

    @property
    def information(self) -> Factors:
        """The factors of Σ r E x_{k−1} x_{k−1}ᵀ."""
        return Factors(self.lower, self.diagonal)

    def faded(self, fraction: Floats) -> Moments:
        """The same with `fraction` (R,) of every weight."""
        return Moments(self.lower, *(part * fraction for part in self[1:]))

    def added(self, A: Floats, z: Floats, heard: Floats, last: Transition) -> Moments:
        """These and the transition to a slot whose packets are z (n, R), 0 where none was heard (R,); A (n, n, R)."""
        rows, weights = [list(row) for row in self.information.unit()], list(self.diagonal)
        cross, square = self.cross, self.square
        for c in np.flatnonzero(last.fraction.any(axis=1)):
            fraction, before = last.fraction[c], last.before[:, c]
            spread = Factors(last.spread.lower[:, c], last.spread.diagonal[:, c])
            away, carried = z - applied(A, before), multiplied(A, covariance(spread))
            cross = cross + fraction * (away[:, None] * before[None] - carried)
            square = square + fraction * (away[:, None] * away[None] + outer(carried, A))
            for row, value, unit in zip(rows, before, spread.unit(), strict=True):
                row += [value, *unit]
            weights += [fraction, *(fraction * D for D in spread.diagonal)]
        state = summed(last.fraction)
        return Moments(
            *orthogonalised(rows, weights),
            cross,
            square,
            self.transitions + state,
            self.states + state,
            self.packets + heard,
        )

    def about(self, step: Floats) -> Moments:
        """The same about A + step, (n, n, R)."""
        carried = multiplied(step, covariance(self.information))
        square = self.square - outer(self.cross, step) - outer(step, self.cross) + outer(carried, step)
        return self._replace(cross=self.cross - carried, square=square)

    def most_likely(self, theta: Parameters, scale: Floats, knows: frozenset[str]) -> tuple[Moments, Parameters]:
        """The parameters that make these moments most likely, and the moments about the new A.

        theta: the parameters so far, which stay where they are known; scale: the variance of the first packets, (R,).
        """
        A = theta.A
        if "A" not in knows:
            A = np.clip(A + divided(self.cross, self.information), -_LARGEST, _LARGEST)
        moments = self.about(A - theta.A)
        noise = theta.noise if "Q" in knows else factored(moments.square / (self.transitions + 1.0), _LEAST * scale)
        return moments, Parameters(A, *noise, theta.mu_d if "mu_d" in knows else self.states / self.packets)


def factored(M: Floats, least: Floats) -> Factors:
    """Factors of symmetric matrices (n, n, R), with D not below `least` (R,): they may be semidefinite but for rounding."""
    n, _, trials = M.shape
    U, D = np.zeros_like(M), np.empty((n, trials))
    for j in range(n):
        for i in range(j, n):
            rest = M[i, j]
            for c in range(j):
                rest = rest - U[i, c] * U[j, c] * D[c]
            if i == j:
                D[j] = np.maximum(rest, least)
            U[i, j] = rest / D[j]
    lower = [U[i, j] for i in range(n) for j in range(i)]
    return Factors(np.array(lower).reshape(len(lower), trials), D)


def divided(M: Floats, P: Factors) -> Floats:
    """M P⁻¹ of every trial, (n, n, R): row by row, by substitution forwards and backwards."""
    n, U = len(M), P.unit()
    found = np.empty_like(M)
    for r, row in enumerate(M):
        y: list[Floats] = []
        for i in range(n):
            rest = row[i]
            for j in range(i):
                rest = rest - U[i][j] * y[j]
            y.append(rest)
        for i, value in enumerate(y):
            found[r, i] = value / P.diagonal[i]
    return backwards(found, P)


def backwards(M: Floats, P: Factors) -> Floats:
    """M U⁻¹ of every trial, (n, n, R), U of the factors P."""
    n, U = len(M), P.unit()
    found = np.empty_like(M)
    for r, row in enumerate(M):
        for i in reversed(range(n)):
            rest = row[i]
            for j in range(i + 1, n):
                rest = rest - U[j][i] * found[r, j]
            found[r, i] = rest
    return found


def applied_factors(P: Factors, M: Floats) -> Floats:
    """U D^½ M of every trial, (n, n, R), from the factors P."""
    U, scaled = P.unit(), np.sqrt(P.diagonal)[:, None] * M
    found = scaled.copy()
    for i in range(len(M)):
        for j in range(i):
            found[i] = found[i] + U[i][j] * scaled[j]
    return found


def multiplied(M: Floats, N: Floats) -> Floats:
    """M N of every trial, (n, n, R)."""
    found: Floats = M[:, 0, None] * N[0]
    for j in range(1, len(N)):
        found = found + M[:, j, None] * N[j]
    return found


def outer(M: Floats, N: Floats) -> Floats:
    """M Nᵀ of every trial, (n, n, R)."""
    return multiplied(M, N.swapaxes(0, 1))


def applied(M: Floats, x: Floats) -> Floats:
    """M x of every trial, (n, R)."""
    found: Floats = M[:, 0] * x[0]
    for j in range(1, len(x)):
        found = found + M[:, j] * x[j]
    return found
