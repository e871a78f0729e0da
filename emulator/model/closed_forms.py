"""Closed forms of schemes that the outcomes of a slot alone do not give: bounds, and chains with a memory.

Source: docs/mathematics.md, twin track.
"""

from __future__ import annotations

import numpy as np

from emulator.model.process import Floats, Process


def twin_track_bound(process: Process, slots: int) -> Floats:
    """½ tr A^k Σ0 A^kᵀ for k = 0 … slots−1, (slots,): no eavesdropper of twin tracks has a smaller mean squared error.

    Holds for μ_e = 1 and unlimited means, without coin and starts. inf once it overflows.

    Source: docs/mathematics.md, twin track.
    """
    bound = np.empty(slots)
    grown = process.initial_covariance
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            trace = 0.5 * float(np.trace(grown))
            bound[k] = trace if np.isfinite(trace) else np.inf
            grown = process.A @ grown @ process.A.T
    return bound
