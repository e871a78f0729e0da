"""How long float64 can follow a process: until rounding of the state drowns the innovation hidden in it."""

from __future__ import annotations

import math

import numpy as np

from emulator.model.process import Process
from emulator.model.theory import NOBODY, ExpectedCovariance

UNIT_ROUNDOFF = 2.0**-53
TOLERANCE = 0.01
_NO_NOISE = 1e-12  # of the largest eigenvalue of a singular Q: what rounding explains
_AHEAD = 65_536  # slots looked at in one step


def horizon(process: Process, slots: int) -> int | None:
    """Largest k in float64's reach, if it is below slots−1; None if the whole run is.

    The last k such that up to it 2⁻⁵³ √λ_max(Σ_k) ≤ 0.01 √λ_min(Q).

    Source: docs/mathematics.md, horizon.
    """
    noise = np.linalg.eigvalsh(process.Q)
    least = noise[noise > _NO_NOISE * noise[-1]][0] if process.singular_noise and noise[-1] > 0.0 else noise[0]
    limit = (TOLERANCE / UNIT_ROUNDOFF) ** 2 * float(least)
    states = ExpectedCovariance(process, NOBODY)
    for first in range(0, slots, _AHEAD):
        sigma = states.next(min(_AHEAD, slots - first))
        # The trace bounds the largest eigenvalue, so almost always nothing needs to be decomposed.
        with np.errstate(over="ignore"):
            doubtful = np.flatnonzero(~(np.trace(sigma, axis1=1, axis2=2) <= limit))
        for k in doubtful.tolist():
            if not np.isfinite(sigma[k]).all() or float(np.linalg.eigvalsh(sigma[k])[-1]) > limit:
                return first + k - 1
        if len(sigma) > 1 and np.array_equal(sigma[-1], sigma[-2]) and not math.isnan(limit):
            return None
    return None
