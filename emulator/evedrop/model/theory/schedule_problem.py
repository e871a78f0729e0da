"""The errors that a schedule of μ_d leads to, and what a schedule is to reach.

Source: docs/mathematics.md, schedules of μ_d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.theory.covariances import Outcomes, OutcomesAt, misled_covariances
from evedrop.model.theory.leak import RemainingCovariances

ROUNDING = 1e-12
"""By how much, relatively, a trace may exceed its bound, or a score another one."""


@final
class SlotRecursion:
    """E P_k of one receiver for many schedules at once, slot by slot: its map of a slot is affine in μ_d(k).

    E_0 = p_0 Σ0, E_k = kept · A E_{k−1} Aᵀ + p_d Q + p_i f_k + p_l M_k, with probabilities that are affine in μ_d(k).

    Source: docs/mathematics.md, schedules of μ_d.
    """

    def __init__(self, process: Process, outcomes_at: OutcomesAt, slots: int) -> None:
        never, always = outcomes_at(0.0), outcomes_at(1.0)
        self._A, self._Q = process.A, process.Q
        self._base = _probabilities(never)
        self._slope = _probabilities(always) - self._base
        self.initial: Floats = always.initial * process.initial_covariance
        """E P_0, (n, n): the first packet is always the state."""
        self._misled = misled_covariances(process, slots)
        remaining = RemainingCovariances(process) if never.leaked else None
        self._remaining = np.zeros_like(self._misled)
        if remaining is not None:
            for k in range(1, slots):
                self._remaining[k] = remaining.next()

    def next(self, k: int, E: Floats, mu_d: Floats) -> Floats:
        """E P_k, (S, n, n), from E P_{k−1}, (S, n, n), with μ_d(k), (S,)."""
        kept, predicted, misled, leaked = (self._base[:, None] + self._slope[:, None] * mu_d)[:, :, None, None]
        found: Floats = (
            kept * (self._A @ E @ self._A.T)
            + predicted * self._Q
            + misled * self._misled[k]
            + leaked * self._remaining[k]
        )
        return found

    def traces(self, mu_d: Floats) -> Floats:
        """Trace of E P_k for k = 0 … N−1 of schedules, (S, N) → (S, N); μ_d(0) is taken as 1."""
        found = np.empty(mu_d.shape)
        E = np.broadcast_to(self.initial, (len(mu_d), *self.initial.shape))
        found[:, 0] = np.trace(self.initial)
        for k in range(1, mu_d.shape[1]):
            E = self.next(k, E, mu_d[:, k])
            found[:, k] = np.trace(E, axis1=1, axis2=2)
        return found


def _probabilities(outcomes: Outcomes) -> Floats:
    return np.array([outcomes.kept, outcomes.predicted, outcomes.misled, outcomes.leaked])


@dataclass(frozen=True)
class ScheduleProblem:
    """What a schedule is to reach: the largest Σ_k (1 − weight) tr E Pᵉ_k − weight tr E P_k with tr E P_k ≤ Ω in each slot."""

    user: SlotRecursion
    eavesdropper: SlotRecursion
    slots: int
    max_trace: float
    """Ω; inf for no bound."""
    weight: float

    def sums(self, mu_d: Floats) -> Floats:
        """The sum of each schedule, (S, N) → (S,); −inf for those that violate Ω."""
        ours, theirs = self.user.traces(mu_d), self.eavesdropper.traces(mu_d)
        total = ((1.0 - self.weight) * theirs - self.weight * ours).sum(axis=1)
        return np.where((ours <= self.max_trace * (1.0 + ROUNDING)).all(axis=1), total, -np.inf)

    def sum_of(self, mu_d: Floats) -> float:
        """The sum of one schedule, (N,)."""
        return float(self.sums(mu_d[None])[0])
