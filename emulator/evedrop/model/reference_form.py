"""The error of a reader of state-secrecy codes: its closed form, or a lower bound on it.

The bound holds for a code whose packets are independent of the state that they are sent for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats, Process
from evedrop.model.reference_code import ReferenceCode, triangular_solutions
from evedrop.model.staircase import is_singular
from evedrop.model.theory.closed_forms import ClosedForm, ReceiverConditions, reference_covariances, reference_limit
from evedrop.model.theory.covariances import NOBODY, Outcomes, has_infinite_variance, limit_trace, traces_of_slots

Counts = NDArray[np.int64]
_APART = 64  # critical slots whose consequences are computed each by itself: the first
_MERGED = 8  # later ones, or equal groups of them, that are merged at a time, in pairs; as many newer ones stay apart


def reference_floor(process: Process, received: float, acknowledged: tuple[float, float], slots: int) -> Floats:
    """A lower bound on tr E P_k for k = 0 … slots−1, (slots,), for nonsingular A; inf from where it overflows.

    Arguments as for `reference_covariances`. With c the probability of a critical slot, acknowledged and not heard,

        E P_k ≥ E[P_k; no critical slot yet] + c Σ_j (1−c)^j F_{j,k},

    where F_{j,k} is the error if slot j is the first critical slot, x_{j−1} is known exactly and every later packet is heard:
    Σ_k for j = 0, then by the recursion of the exact reader. It is exact where c = 0. After the first slots j, neighbours are
    followed as one, with an error that is at most that of each of them; if Q is singular, that may be 0, and they are left out.
    """
    c = acknowledged[1]
    unheard, spared = 1.0 - received - c, 1.0
    A, Q, G = process.A, process.Q, process.noise_factor
    code, n, singular = ReferenceCode(process), process.n, is_singular(process)
    white = triangular_solutions(np.broadcast_to(G, (n, n, n)), np.eye(n))
    sigma, before = process.initial_covariance, np.zeros_like(Q)
    D, weights, counts = np.empty((0, n, n)), np.empty(0), np.empty(0, np.int64)
    bounds = np.empty(slots)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(slots):
            if k:
                sigma = A @ sigma @ A.T + Q
                before = unheard * (A @ before @ A.T + spared * Q)
                L = code.at(k)
                D = _heard(white @ (L - A) @ D, L @ D)
                if not singular or k <= _APART:
                    D = np.concatenate([D, G[None]])
                    weights, counts = np.append(weights, c * spared), np.append(counts, 1)
            else:
                before = unheard * sigma
            spared *= 1.0 - c
            bound = np.trace(before) + c * np.trace(sigma) + weights @ (D * D).sum(axis=(1, 2))
            if not np.isfinite(bound):
                bounds[k:] = np.inf
                break
            bounds[k] = bound
            if k % _MERGED == 0:
                D, weights, counts = _merged(D, weights, counts)
    return bounds


def _merged(D: Floats, weights: Floats, counts: Counts) -> tuple[Floats, Floats, Counts]:
    """The same with fewer factors: of groups of as many slots, the oldest are merged in pairs. counts: slots of each."""
    for count in sorted(set(counts[_APART:].tolist()), reverse=True):
        places = _APART + np.flatnonzero(counts[_APART:] == count)
        if len(places) >= 2 * _MERGED:
            older, newer = places[:_MERGED:2], places[1:_MERGED:2]
            D[newer], weights[newer] = _least(D[older], D[newer]), weights[older] + weights[newer]
            counts[newer] *= 2
            kept = np.delete(np.arange(len(D)), older)
            D, weights, counts = D[kept], weights[kept], counts[kept]
    return D, weights, counts


def _least(older: Floats, newer: Floats) -> Floats:
    """Factors of covariances that are at most those of both factors, (c, n, n) each.

    older: lower triangular, nonsingular. In the coordinates in which its covariance is 1 and the other's diagonal, the smaller
    entries count.
    """
    count, n, _ = older.shape
    columns = triangular_solutions(np.repeat(older, n, axis=0), newer.transpose(1, 0, 2).reshape(n, count * n))
    u, s, _ = np.linalg.svd(columns.reshape(n, count, n).transpose(1, 0, 2))
    least: Floats = older @ (u * np.minimum(s, 1.0)[:, None])
    return least


def _heard(seen: Floats, carried: Floats) -> Floats:
    """The errors' factors after a packet x − r, (c, n, n): seen, of x − r before its noise, which is whitened; carried, of r."""
    count, n, _ = seen.shape
    joint = np.zeros((count, 2 * n, 2 * n))
    joint[:, :n, :n], joint[:, :n, n:], joint[:, n:, n:] = np.eye(n), seen, carried
    return kernels.triangular_factors(joint)[:, n:, n:]


@final
@dataclass(frozen=True)
class ReferenceForm(ClosedForm):
    """That of a receiver that keeps the references it may have acknowledged."""

    process: Process
    slots: int
    received: float
    """The probability that it receives a packet that is sent."""
    acknowledged: tuple[float, float]
    """Probabilities that a packet is acknowledged and the receiver heard it, and that it is acknowledged and it did not."""
    bound: bool = False

    @classmethod
    def of(cls, process: Process, conditions: ReceiverConditions, *, open_loop: bool) -> ReferenceForm | None:
        """The form under a receiver's conditions; None for the legitimate estimator if it misses no reference: it learns more.

        open_loop: whether references are carried by A, so that packets depend on the state.
        """
        received, acknowledged = conditions.received, conditions.acknowledged
        if received is None or acknowledged is None or conditions.hijack is not None:
            return None
        if conditions.legitimate and not conditions.forged:
            return None
        bound = not open_loop and acknowledged[1] > 0.0 and ReferenceCode(process).decorrelates
        return cls(process, conditions.slots, received, acknowledged, bound)

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        if self.bound:
            return reference_floor(self.process, self.received, self.acknowledged, self.slots)
        return traces_of_slots(reference_covariances(self.process, self.received, self.acknowledged, self.slots))

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded, NaN if it is too large to compute."""
        if self.bound:
            # After the first critical slot it knows less and less, in the end no more than a receiver that hears nothing.
            return limit_trace(self.process, NOBODY)
        return reference_limit(self.process, self.received, self.acknowledged)

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance over trials has no bound: only where no packet is acknowledged that the reader did not hear.

        After such a packet nothing ends the growth of its error, in any trial.

        Source: docs/mathematics/model.md, heavy tails.
        """
        return self.acknowledged[1] == 0.0 and has_infinite_variance(self.process, Outcomes.plain(self.received))
