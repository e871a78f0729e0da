"""Closed forms of schemes that the outcomes of a slot alone do not give: bounds, and chains with a memory.

Source: docs/mathematics.md, twin track, acknowledged references, schedules by holding time.
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


def reference_covariances(process: Process, received: float, acknowledged: tuple[float, float], slots: int) -> Floats:
    """E P_k of a reader of state-secrecy codes with L = A, for k = 0 … slots−1, (slots, n, n); inf from where it overflows.

    received: the probability that it hears a packet. acknowledged: the probabilities that the packet is acknowledged to
    the sensor and it heard it, and that it is acknowledged and it did not. With P⁻ and R⁻ the error and the error of the
    reference, each carried on,

        P_k = R⁻ if heard, else P⁻;   R_k = P_k if acknowledged, else R⁻;   R = 0 before the first acknowledgement,

    which is linear in (P, R), so the expectations follow it.

    Source: docs/mathematics.md, acknowledged references.
    """
    _, unheard = acknowledged
    found = np.empty((slots, process.n, process.n))
    P = R = np.zeros_like(process.Q)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            A = process.A
            predicted = A @ P @ A.T + process.Q if k else process.initial_covariance
            carried = A @ R @ A.T
            P = received * carried + (1.0 - received) * predicted
            R = (1.0 - unheard) * carried + unheard * predicted
            if not np.isfinite(P).all():
                found[k:] = np.inf
                break
            found[k] = P
    return found
