"""A lower bound on the error of a reader of the state-secrecy code whose packets are independent of the state.

Source: docs/mathematics.md, acknowledged references.
"""

from __future__ import annotations

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process
from evedrop.model.reference_code import ReferenceCode

_FOLLOWED = 32  # critical slots whose consequences are computed each by itself


def reference_floor(process: Process, received: float, acknowledged: tuple[float, float], slots: int) -> Floats:
    """A lower bound on tr E P_k for k = 0 … slots−1, (slots,), for nonsingular A; inf from where it overflows.

    Arguments as for `reference_covariances`. With c the probability of a critical slot, acknowledged and not heard,

        E P_k ≥ E[P_k; no critical slot yet] + c Σ_j (1−c)^j F_{j,k},

    where F_{j,k} is the error if slot j is the first critical slot, x_{j−1} is known exactly and every later packet is heard:
    Σ_k for j = 0, then by the recursion of the exact reader. It is exact where c = 0. Of many slots j, some stand for
    themselves and those before them, because F_{j,k} falls in j.
    """
    c = acknowledged[1]
    unheard, spared = 1.0 - received - c, 1.0
    A, Q, G = process.A, process.Q, process.noise_factor
    code, n = ReferenceCode(process), process.n
    sigma, before = process.initial_covariance, np.zeros_like(Q)
    D, weights, first, spacing = np.empty((0, n, n)), np.empty(0), np.empty(0, np.int64), 1
    waiting = 0.0
    found = np.empty(slots)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            if k:
                sigma = A @ sigma @ A.T + Q
                before = unheard * (A @ before @ A.T + spared * Q)
                L = code.at(k)
                D = _heard((A - L) @ D, L @ D, G)
                waiting += c * spared
                if (k - 1) % spacing == 0:
                    D, first = np.concatenate([D, G[None]]), np.append(first, k)
                    weights, waiting = np.append(weights, waiting), 0.0
            else:
                before = unheard * sigma
            if len(first) > _FOLLOWED:
                # The mass of a slot that is no longer followed goes to the next one that is.
                spacing *= 2
                kept = np.flatnonzero((first - 1) % spacing == 0)
                sums = np.add.reduceat(weights, np.append(0, kept[:-1] + 1))
                waiting += weights[kept[-1] + 1 :].sum()
                D, weights, first = D[kept], sums, first[kept]
            spared *= 1.0 - c
            bound = np.trace(before) + c * np.trace(sigma) + weights @ (D * D).sum(axis=(1, 2))
            if not np.isfinite(bound):
                found[k:] = np.inf
                break
            found[k] = bound
    return found


def _heard(apart: Floats, carried: Floats, G: Floats) -> Floats:
    """The errors' factors after a packet x − r, (c, n, n): apart, those of x − r before its noise; carried, those of r."""
    count, n, _ = apart.shape
    joint = np.zeros((count, 2 * n, 2 * n))
    joint[:, :n, :n], joint[:, :n, n:], joint[:, n:, n:] = G, apart, carried
    return kernels.triangular_factors(joint)[:, n:, n:]
