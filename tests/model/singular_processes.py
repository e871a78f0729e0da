"""Processes whose Q is singular, for the tests of receivers, theory and coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evedrop.model.process import Process
from tests.model.rationals import Matrix, combined, congruent, exact


def process_of(A: Sequence[Sequence[float]], G: Sequence[Sequence[float]]) -> Process:
    """A process with Q = G Gᵀ and Σ0 = 1; the entries are multiples of powers of two, so Q is exact."""
    noise = np.array(G, np.float64)
    return Process(np.array(A, np.float64), noise @ noise.T, np.eye(len(A)), singular_noise=True)


PROCESSES = {
    "double integrator": process_of([[1.0, 0.125], [0.0, 1.0]], [[0.0], [0.25]]),
    "sampled force": process_of([[1.0, 0.125], [0.0, 1.0]], [[1 / 128], [1 / 8]]),
    "three integrators": process_of([[1.0, 0.25, 0.0], [0.0, 1.0, 0.25], [0.0, 0.0, 1.0]], [[0.0], [0.0], [0.5]]),
    "two of three": process_of(
        [[0.75, 0.25, 0.0], [0.0, 0.5, 0.0], [0.25, 0.0, 1.25]], [[0.5, 0.0], [0.25, 0.5], [0.0, 0.25]]
    ),
    "a mode without noise": process_of([[1.25, 0.0], [0.25, 0.5]], [[0.0], [0.5]]),
    "no noise": process_of([[1.0, 0.25], [0.0, 0.5]], [[0.0], [0.0]]),
}


def sigmas(process: Process, slots: int) -> list[Matrix]:
    """Σ_k exactly."""
    sigmas = [exact(process.initial_covariance)]
    for _ in range(slots - 1):
        sigmas.append(combined((1, congruent(exact(process.A), sigmas[-1])), (1, exact(process.Q))))
    return sigmas
