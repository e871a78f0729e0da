"""How many bits an innovation packet reveals to a receiver that knows its type but not the noise that hides it.

z_k = w_{k−1} + χ_k, with χ_k ~ N(0, C_k), C_k = A Σ_{k−1} Aᵀ. The mutual information of w_{k−1} and z_k is
½ log₂ det(C_k + Q) / det C_k = ½ log₂ det Q / det M_k. With the columns q_j of Q^½ added one after the other,

    det(C + Σ_{i≤j} q_i q_iᵀ) = det(C + Σ_{i<j} q_i q_iᵀ) (1 + |L_j⁻¹ q_j|²),   L_j L_jᵀ = C + Σ_{i<j} q_i q_iᵀ,

so the bits are a sum of logarithms of numbers above 1, and nothing cancels.

Source: docs/mathematics.md, leak in bits.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from evedrop.kernels.current import kernels
from evedrop.kernels.elementary import cholesky
from evedrop.model.process import Floats, Process, product
from evedrop.model.theory.covariances import block_length

_AS_GOOD_AS_INFINITE = 1e60  # a deviation of the state relative to the noise's, with which a packet reveals nothing


def leaked_bits(process: Process, slots: int) -> Floats:
    """The bits that an innovation packet reveals in each slot k = 0 … slots−1, (slots,); 0 in slot 0. A must be regular.

    Also valid in slots beyond the horizon, where Σ_k exceeds double precision.

    Source: docs/mathematics.md, leak in bits.
    """
    matrices = (np.float64(one).tobytes() for one in (process.A, process.noise_factor, process.initial_covariance))
    return _leaked_bits(*matrices, process.n, slots)


@lru_cache(maxsize=4)
def _leaked_bits(dynamics: bytes, factor: bytes, initial: bytes, n: int, slots: int) -> Floats:
    """The same from A, Q^½ and Σ0 as bytes; not to be changed. A study asks for the same ones for each block of its trials."""
    A, noise, start = (np.frombuffer(one).reshape(n, n) for one in (dynamics, factor, initial))
    largest = _AS_GOOD_AS_INFINITE * float(np.abs(noise).max()) or math.inf
    length = block_length(A)
    found = np.zeros(max(slots, 1))
    carried, k = product(A, cholesky(start)), 1
    while k < slots:
        more = kernels.carried_factors(A, noise, carried, min(length, slots - k))
        factors = np.concatenate([carried[None], more])
        found[k : k + len(more)] = _bits(factors[:-1], noise)
        # A column that is scaled down still means a variance that is as good as infinite.
        carried = more[-1] / np.maximum(1.0, np.abs(more[-1]).max(axis=0) / largest)
        k += len(more)
    found = found[:slots]
    found.flags.writeable = False
    return found


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
        y[:, i] = (q[i] - (L[:, i, :i] * y[:, :i]).sum(axis=1)) / L[:, i, i]
    return y
