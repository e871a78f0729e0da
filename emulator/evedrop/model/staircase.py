"""Coordinates in which a singular Q has exact zeros: the states in the order in which the process noise reaches them.

With Q = G Gᵀ of rank r < n the noise of m slots reaches the range of [G, A G, …, A^{m−1} G]. In the staircase form x = T s the
states that noise reaches later come first, and those that it never reaches come before all others; Q becomes diag(0, 1). Every
covariance that began as 0 then has rows of exact zeros, in floating point too. Which ranges there are is decided here, once.

Source: docs/mathematics/numerics.md, singular noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np

from evedrop.model.kernels.elementary import Floats, cholesky, inverse, sum_in_order, triangular_factor
from evedrop.model.kernels.reference import carry
from evedrop.model.process import Process, product
from evedrop.model.schedule import NoiseDistribution

NOT_REACHED = 2.0**-44
"""The largest rest of a direction that is already reached, relative to the numbers it was computed from."""
REACHED = 2.0**-20
"""The same if it certainly is not. Double precision cannot tell what lies between the two."""
ROUNDING = 2.0**-50
"""The standard deviation of the rounding of a packet, relative to the numbers that it is computed from."""
_BY_CHANCE = 1e-6
_STANDARD_DEVIATIONS = 40.0  # from the range, in standard deviations of rounding, at which a packet is outside of it
_NONSINGULAR = 0.01 * 2.0**53  # a condition number of A up to which its inverse has correct digits
_CHECKED_ONE_BY_ONE = 64  # slots; later ones whose number is a power of two, and the last

_Vector = list[float]


class _Basis(NamedTuple):
    """Directions that noise reaches, by the number of slots it takes, and an entry of each that all later ones lack."""

    blocks: list[list[_Vector]]
    pivots: list[int]


@final
class Staircase:
    """The coordinates s of a process, x = T s; those of a process with nonsingular Q are x itself.

    Raises ValueError if double precision cannot decide which directions noise reaches, or if A and Q are both singular.
    """

    def __init__(self, process: Process) -> None:
        n = process.n
        self.singular = is_singular(process)
        """Whether Q is singular."""
        self.process = process
        """The process of s, (n,) like x."""
        self.unreached = 0
        """The number of states that noise never reaches; they come first."""
        self.later = 0
        """The number of states that the noise of one slot does not reach, those included."""
        if not self.singular:
            return
        if not is_nonsingular(process.A):
            raise ValueError(
                "A is singular to double precision, and so is Q: a packet then shows part of w without noise"
            )
        scale = [math.sqrt(float(value)) for value in np.diag(process.initial_covariance)]
        blocks, pivots = _reached(process, scale)
        others = [[scale[j] if i == j else 0.0 for i in range(n)] for j in range(n) if j not in pivots]
        self.unreached, self.later = len(others), n - len(blocks[0])
        self._T = np.array([*others, *(vector for block in reversed(blocks) for vector in block)]).T.copy()
        units = np.array(scale)
        self._inverse = inverse(self._T / units[:, None]) / units
        self.process = self._transformed(process, [len(others), *(len(block) for block in reversed(blocks))])
        T, back = np.abs(self._T), np.abs(self._inverse)
        self._errors: Floats = product(product(back, np.eye(n) + np.abs(process.A)), product(T, back))

    def _transformed(self, process: Process, sizes: list[int]) -> Process:
        """The process of s. sizes: of its blocks of states, from those that noise never reaches to those it reaches at once."""
        A = product(product(self._inverse, process.A), self._T)
        ends = np.cumsum(sizes)
        for block, end in enumerate(ends.tolist()):
            # One slot later noise reaches the block before, and none further up; it never reaches the first.
            A[: ends[max(block - 2, 0)] if block else 0, end - sizes[block] : end] = 0.0
        Q = np.diag(np.where(np.arange(process.n) < self.later, 0.0, 1.0))
        L = product(self._inverse, cholesky(process.initial_covariance))
        L = np.array(triangular_factor(L.tolist()))
        initial = product(L, L.T.copy())
        return Process(A, Q, 0.5 * (initial + initial.T), singular_noise=True)

    def inward(self, x: Floats) -> Floats:
        """T⁻¹ x of states or packets, (n, R) or (c, n, R)."""
        return product(self._inverse, x) if self.singular else x

    def outward(self, s: Floats) -> Floats:
        """T s, (n, R) or (c, n, R)."""
        return product(self._T, s) if self.singular else s

    def inward_covariance(self, P: Floats) -> Floats:
        """T⁻¹ P T⁻ᵀ, (n, n, R)."""
        return carry(self._inverse, P) if self.singular else P

    def inward_distribution(self, distribution: NoiseDistribution) -> NoiseDistribution:
        """The distribution of T⁻¹ n, from that of noise n that is sent in place of states."""
        N = distribution.covariance
        if N is None or not self.singular:
            return distribution
        carried = carry(self._inverse, N[:, :, None])[:, :, 0]
        return NoiseDistribution(0.5 * (carried + carried.T))

    def outward_covariance(self, P: Floats) -> Floats:
        """T P Tᵀ, (n, n, R) or (c, n, n, R)."""
        if not self.singular:
            return P
        if P.ndim == 3:
            return carry(self._T, P)
        slots, n, _, trials = P.shape
        carried = carry(self._T, np.moveaxis(P, 0, 2).reshape(n, n, slots * trials))
        return np.ascontiguousarray(np.moveaxis(carried.reshape(n, n, slots, trials), 2, 0))

    def rounding(self, factors: Floats) -> Floats:
        """Variance of the rounding of s, (c, n), for states with the covariances L Lᵀ, from L (c, n, n). Q must be singular."""
        L = product(self._T, factors)
        squared = L[:, :, 0] * L[:, :, 0]
        for j in range(1, L.shape[2]):
            squared += L[:, :, j] * L[:, :, j]
        standard_deviation = ROUNDING * product(self._errors, np.sqrt(squared).T.copy()).T
        return np.ascontiguousarray(standard_deviation * standard_deviation)

    def outside(self, factor: Floats) -> Floats:
        """The part of a noise's factor (n, m) outside the range of Q, (l, m), relative to the numbers it is computed from."""
        if not self.singular:
            return np.zeros((0, factor.shape[1]))
        part = np.abs(product(self._inverse[: self.later], factor))
        size = product(np.abs(self._inverse[: self.later]), np.abs(factor))
        ratios = np.zeros(part.shape)
        np.divide(part, size, out=ratios, where=size > 0.0)
        return ratios

    def blurred(self, factors: Floats, rounding: Floats) -> bool:
        """Whether an innovation is within rounding of a state with a probability above 1e-6, in any of c slots.

        factors: L (c, n, n), with the covariances L Lᵀ of innovations; rounding: as from the method of that name, (c, n).
        """
        own = np.sqrt((factors[:, : self.later] ** 2).sum(axis=2))
        near = _STANDARD_DEVIATIONS * np.sqrt(rounding[:, : self.later])
        return bool((near > _BY_CHANCE * own).any())


def checked_slots(slots: int) -> list[int]:
    """The slots of a run at which `Staircase.blurred` is asked."""
    powers = [2**i for i in range(slots.bit_length()) if 2**i >= _CHECKED_ONE_BY_ONE]
    return sorted(
        {
            *range(1, min(slots, _CHECKED_ONE_BY_ONE)),
            *(k for k in powers if k < slots),
            *range(max(1, slots - 1), slots),
        }
    )


ROUNDING_OF_PACKETS = 2.0**-44
"""The standard deviation of the rounding of a packet where Q is singular, relative to the numbers that it is computed from."""


def is_singular(process: Process) -> bool:
    """Whether Q has a direction without variance, and is allowed to."""
    return process.singular_noise and bool(np.any(np.diag(process.noise_factor) == 0.0))


def is_nonsingular(A: Floats) -> bool:
    """Whether A⁻¹ has correct digits in double precision."""
    try:
        size = float(np.abs(A).max()) * float(np.abs(inverse(A)).max())
    except ValueError:
        return False
    return size <= _NONSINGULAR


def _reached(process: Process, scale: _Vector) -> _Basis:
    """The directions that noise reaches in one slot, and those it reaches first in each slot after it."""
    G, A = process.noise_factor, process.A.tolist()
    pivots = [j for j in range(process.n) if G[j, j] > 0.0]
    block = [G[:, j].tolist() for j in pivots]
    blocks, basis = [block], list(zip(pivots, block, strict=True))
    while block and len(pivots) < process.n:
        block = []
        for v in blocks[-1]:
            rest = _remainder(A, v, basis)
            if rest is None:
                continue
            pivot = max(range(process.n), key=lambda i, rest=rest: abs(rest[i]) / scale[i])  # type: ignore[misc]
            size = abs(rest[pivot]) / scale[pivot]
            block.append([value / size for value in rest])
            pivots.append(pivot)
            basis.append((pivot, block[-1]))
        if block:
            blocks.append(block)
    return _Basis(blocks, pivots)


def _remainder(A: list[_Vector], v: _Vector, basis: list[tuple[int, _Vector]]) -> _Vector | None:
    """A v without its part in the span of the basis; None if nothing else is left. Raises ValueError if that is in doubt."""
    rest = [math.fsum(a * value for a, value in zip(row, v, strict=True)) for row in A]
    size = [sum_in_order(abs(a * value) for a, value in zip(row, v, strict=True)) for row in A]
    for pivot, earlier in basis:
        factor = rest[pivot] / earlier[pivot]
        size = [s + abs(factor * value) for s, value in zip(size, earlier, strict=True)]
        rest = [value - factor * other for value, other in zip(rest, earlier, strict=True)]
        rest[pivot] = 0.0
    rest = [value if abs(value) > NOT_REACHED * s else 0.0 for value, s in zip(rest, size, strict=True)]
    left = max((abs(value) / s for value, s in zip(rest, size, strict=True) if value), default=0.0)
    if 0.0 < left < REACHED:
        raise ValueError(
            f"double precision cannot decide which states the noise of Q reaches: what is left of a direction is {left:.1e} "
            f"of the numbers it is computed from; expected below {NOT_REACHED:.0e} or above {REACHED:.0e}"
        )
    return rest if left else None
