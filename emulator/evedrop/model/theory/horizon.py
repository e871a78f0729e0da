"""How long float64 can follow a process: until rounding of the state exceeds the innovation hidden in it."""

from __future__ import annotations

import math

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.theory.covariances import NOBODY, TheoreticalCovariance, without_cancellation

UNIT_ROUNDOFF = 2.0**-53
TOLERANCE = 0.01
_NO_NOISE = 1e-12  # relative to the largest eigenvalue of a singular Q: eigenvalues below it are rounding
_EACH = 2**17  # numbers
_AT_LEAST = 1024


def horizon(process: Process, slots: int, checked: int = _EACH) -> int | None:
    """Largest k within float64's reach, if it is below slots−1; None if the whole run is within it.

    The last k such that up to it 2⁻⁵³ √λ_max(Σ_k) ≤ 0.01 √λ_min(Q). Each of the first thousands of slots is checked; after
    them Σ_k is assumed to grow from slot to slot, because it has outgrown its beginning.

    checked: how many numbers the covariances of the slots may have that are checked one by one; later slots are bisected.

    Source: docs/mathematics/numerics.md, horizon.
    """
    noise = np.linalg.eigvalsh(process.Q)
    least = noise[noise > _NO_NOISE * noise[-1]][0] if process.singular_noise and noise[-1] > 0.0 else noise[0]
    limit = (TOLERANCE / UNIT_ROUNDOFF) ** 2 * float(least)
    process, _ = without_cancellation(process)
    states = TheoreticalCovariance(process, NOBODY)
    count = min(slots, max(_AT_LEAST, checked // process.n**2))
    ahead = max(2, checked // (16 * process.n**2))
    sigma = process.initial_covariance[None]
    for first in range(0, count, ahead):
        sigma = states.next(min(ahead, count - first))
        # The trace bounds the largest eigenvalue, so a decomposition is hardly ever needed.
        with np.errstate(over="ignore"):
            doubtful = np.flatnonzero(~(np.trace(sigma, axis1=1, axis2=2) <= limit))
        for k in doubtful.tolist():
            if _beyond(sigma[k], limit):
                return first + k - 1
        if len(sigma) > 1 and np.array_equal(sigma[-1], sigma[-2]) and not math.isnan(limit):
            return None
    last = _last_within(process, sigma[-1], count - 1, slots - 1, limit)
    return None if last == slots - 1 else last


def _beyond(sigma: Floats, limit: float) -> bool:
    return not np.isfinite(sigma).all() or float(np.linalg.eigvalsh(sigma)[-1]) > limit


def _last_within(process: Process, sigma: Floats, k: int, last: int, limit: float) -> int:
    """The last slot up to `last` within the limit, searched from slot k on, whose covariance is `sigma`."""
    # A^m and W_m = Σ_{l<m} A^l Q A^lᵀ for m = 1, 2, 4, …: m slots later, Σ is A^m Σ A^mᵀ + W_m.
    steps = [(1, process.A, process.Q)]
    with np.errstate(over="ignore", invalid="ignore"):
        while 2 * steps[-1][0] <= last - k:
            m, power, W = steps[-1]
            steps.append((2 * m, power @ power, power @ W @ power.T + W))
        for m, power, W in reversed(steps):
            # Twice, because the remainder need not be a sum of distinct steps.
            for _ in range(2):
                further = power @ sigma @ power.T + W
                if k + m <= last and not _beyond(further, limit):
                    sigma, k = further, k + m
    return k
