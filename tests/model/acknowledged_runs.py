"""Runs of the state-secrecy codes over given events, for the tests of the code, its receivers and their theory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import cache

import numpy as np

from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.process import Process
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.streams import Batch
from tests.model.rationals import Matrix, exact, identity, inverted, state_covariances, times, transposed
from tests.model.slot_loop import Played, play

MIXED = Process(
    np.array([[1.2, 0.1], [0.0, 0.5]]), np.array([[0.6, 0.2], [0.2, 0.5]]), np.array([[4.0, 0.0], [0.0, 0.3]])
)
"""One unstable mode and a stable one."""
SINGULAR = Process(np.array([[1.1, 0.0], [0.0, 0.0]]), 0.1 * np.eye(2), np.eye(2))


def played_over(
    process: Process,
    gamma: np.ndarray,
    gamma_e: np.ndarray,
    acks: np.ndarray,
    scheme: type[Scheme] = Acknowledged,
) -> Played:
    """The scheme with one eavesdropper of references, over given events, all (slots, R)."""
    slots, trials = gamma.shape
    batch = Batch(slots, trials)
    eve = STRATEGIES["reference"](Knowledge(process, 1.0, {}, {}), batch)
    links = {"legitimate": gamma, "eve": gamma_e}
    return play(scheme(process), batch, links, {"eve": eve}, lambda k, *_: acks[k])


def all_events(slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every course that γ, γᵉ and the acknowledgement channel may take, one a trial: three of (slots, 8^slots)."""
    courses = np.array(list(itertools.product(range(8), repeat=slots))).T
    return courses % 2 == 1, courses // 2 % 2 == 1, courses // 4 == 1


def carried(process: Process, t: int, k: int, scheme: type[Scheme] = Acknowledged) -> np.ndarray:
    """The matrix by which the reference of slot t is carried to slot k, from its definition in exact rationals."""
    A = exact(process.A)
    power = identity(process.n)
    for _ in range(k - t):
        power = times(A, power)
    if scheme is Acknowledged and process is not SINGULAR:
        sigmas = _first_sigmas(*(M.tobytes() for M in (process.A, process.Q, process.initial_covariance)), k + 1)
        power = times(sigmas[k], transposed(inverted(power)), inverted(sigmas[t]))
    return np.array([[float(value) for value in row] for row in power])


@cache
def _first_sigmas(A: bytes, Q: bytes, initial: bytes, slots: int) -> list[Matrix]:
    """The state's covariances in the first slots; the matrices are given as their doubles."""
    n = math.isqrt(len(A) // 8)
    of_process = [exact(np.frombuffer(matrix).reshape(n, n)) for matrix in (A, Q, initial)]
    return list(itertools.islice(state_covariances(of_process[0], of_process[1], of_process[2], 200), slots))


def exact_sigmas(process: Process) -> Iterator[np.ndarray]:
    """The state's covariances from exact rationals."""
    sigmas = state_covariances(exact(process.A), exact(process.Q), exact(process.initial_covariance))
    return (np.array([[float(v) for v in row] for row in sigma]) for sigma in sigmas)
