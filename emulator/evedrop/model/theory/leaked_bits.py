"""How many bits an innovation packet reveals to a receiver that knows its type but not the noise that hides it.

z_k = w_{k−1} + χ_k, with χ_k ~ N(0, C_k), C_k = A Σ_{k−1} Aᵀ. The mutual information of w_{k−1} and z_k is
½ log₂ det(C_k + Q) / det C_k = ½ log₂ det Q / det M_k. With the columns q_j of Q^½ added one after the other,

    det(C + Σ_{i≤j} q_i q_iᵀ) = det(C + Σ_{i<j} q_i q_iᵀ) (1 + |L_j⁻¹ q_j|²),   L_j L_jᵀ = C + Σ_{i<j} q_i q_iᵀ,

so the bits are a sum of logarithms of numbers above 1, and nothing cancels.

Source: docs/mathematics/eavesdroppers.md, leak in bits.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import Floats, Process, product
from evedrop.model.streams import BlockByBlock
from evedrop.model.theory.covariances import block_length

# A standard deviation of the state relative to the noise's, with which a packet reveals nothing.
_AS_GOOD_AS_INFINITE = 1e60
_LARGEST_GROWTH = 1e80  # within a block: the square of such a standard deviation that grows by it is still a double


@final
class LeakedBits:
    """The bits that an innovation packet reveals, a number of slots at a time from k = 0; 0 in slot 0. A must be nonsingular.

    Also valid in slots beyond the horizon, where Σ_k exceeds double precision. Values do not depend on how many slots are asked
    for at a time.

    Source: docs/mathematics/eavesdroppers.md, leak in bits.
    """

    def __init__(self, process: Process) -> None:
        self._model = (np.float64(process.A).tobytes(), np.float64(process.noise_factor).tobytes(), process.n)
        self._carried = product(process.A, cholesky(process.initial_covariance)).tobytes()
        self._bits = BlockByBlock(np.zeros(1), self._following)

    def next(self, slots: int) -> Floats:
        """The bits of the next slots, (slots,)."""
        return self._bits.next(slots)

    def _following(self) -> Floats:
        block, self._carried = _next_block(*self._model, self._carried)
        return block


@lru_cache(maxsize=64)
def _next_block(dynamics: bytes, factor: bytes, n: int, start: bytes) -> tuple[Floats, bytes]:
    """The bits of the slots of a block, not to be changed, and a factor of C in the slot after it.

    dynamics, factor, start: A, Q^½ and a factor of C in the first of these slots, as bytes. A study asks for the same ones for
    each block of its trials.
    """
    A, noise, carried = (np.frombuffer(matrix).reshape(n, n) for matrix in (dynamics, factor, start))
    largest = _AS_GOOD_AS_INFINITE * float(np.abs(noise).max()) or math.inf
    more = kernels.carried_factors(A, noise, carried, block_length(A, _LARGEST_GROWTH))
    block = _bits(np.concatenate([carried[None], more[:-1]]), noise)
    block.flags.writeable = False
    # A column that is scaled down still means a variance that is as good as infinite.
    return block, (more[-1] / np.maximum(1.0, np.abs(more[-1]).max(axis=0) / largest)).tobytes()


@final
class RevealedBits:
    """The bits about the path of states that a packet with ν = 0, and one with ν = 1, reveals, from slot 0 on.

    inf: the packet is the state itself.
    """

    def __init__(self, of_state: float, of_other: float | LeakedBits) -> None:
        self._of_state, self._of_other = of_state, of_other

    def next(self, slots: int) -> tuple[Floats, Floats]:
        """Those of the next slots, (slots,) each."""
        other = self._of_other.next(slots) if isinstance(self._of_other, LeakedBits) else np.full(slots, self._of_other)
        return np.full(slots, self._of_state), other


def _bits(carried: Floats, noise: Floats) -> Floats:
    """½ log₂ det(C + Q) / det C of every slot, (c,), from factors of C, (c, n, n), and that of Q, (n, n)."""
    total = np.zeros(len(carried))
    L = kernels.triangular_factors(carried)
    for q in noise.T:
        total += np.log1p((_solved(L, q) ** 2).sum(axis=1))
        column = np.broadcast_to(q[:, None], (len(L), len(q), 1))
        L = kernels.triangular_factors(np.concatenate([L, column], axis=2))
    return total / (2.0 * math.log(2.0))


def _solved(L: Floats, q: Floats) -> Floats:
    """L⁻¹ q of every slot, (c, n), from L lower triangular, (c, n, n)."""
    y = np.zeros(L.shape[:2])
    for i in range(len(q)):
        rest = q[i] - (L[:, i, :i] * y[:, :i]).sum(axis=1)
        # Both are 0 in a direction that has no variance, because noise does not reach it, and what it began with has decayed.
        np.divide(rest, L[:, i, i], out=y[:, i], where=rest != 0.0)
    return y
