"""The error of a receiver that takes noise packets for states.

Source: docs/mathematics.md, noise packets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from evedrop.model.noise_distribution import NoiseDistribution
from evedrop.model.process import Floats, Process
from evedrop.model.schedule import StateProbability, in_slot, mean_of
from evedrop.model.theory.closed_form import ClosedForm
from evedrop.model.theory.covariances import (
    NOBODY,
    Outcomes,
    has_infinite_variance,
    limit,
    lyapunov,
    radius,
    state_covariances,
)


@final
@dataclass(frozen=True)
class NoiseTaken:
    """E P_k = p_d (A E P_{k−1} Aᵀ + Q) + p_i (Σ_k + N_k): noise that is used as the state leaves the error x_k − n_k."""

    process: Process
    distribution: NoiseDistribution
    mu_d: StateProbability
    mu_e: float
    """Quality of the receiver's link."""
    uses: tuple[float, float]
    """The probabilities that it uses a state, and noise."""

    @property
    def outcomes(self) -> Outcomes:
        """Those of a slot, on average over the slots; `misled` is the probability p_i that noise is used."""
        return Outcomes.eavesdropper(self.mu_e, mean_of(self.mu_d), *self.uses)

    def covariances(self, slots: int) -> Floats:
        """E P_k for k = 0 … slots−1, (slots, n, n); inf from where it overflows."""
        A, N = self.process.A, self.distribution.covariance
        sigma = state_covariances(self.process, slots)
        found = np.empty_like(sigma)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(slots):
                one = Outcomes.eavesdropper(self.mu_e, in_slot(self.mu_d, k), *self.uses)
                if k == 0:
                    found[k] = one.initial * self.process.initial_covariance
                else:
                    taken = sigma[k] + (sigma[k] if N is None else N)
                    found[k] = one.kept * (A @ found[k - 1] @ A.T) + one.predicted * self.process.Q + one.misled * taken
                if not np.isfinite(found[k]).all():
                    found[k:] = np.inf
                    break
        return found

    @property
    def limit(self) -> Floats:
        """The limit of E P_k with the mean of μ_d, (n, n); all inf for ρ ≥ 1, if noise is ever used."""
        one, N = self.outcomes, self.distribution.covariance
        if one.misled == 0.0:
            return limit(self.process, one)
        if radius(self.process) >= 1.0:
            return np.full_like(self.process.Q, math.inf)
        sigma = limit(self.process, NOBODY)
        source = one.predicted * self.process.Q + one.misled * (sigma + (sigma if N is None else N))
        return lyapunov(replace(self.process, Q=source), one.kept)


@final
@dataclass(frozen=True)
class TakesNoise(ClosedForm):
    """That of a receiver that mistakes noise packets for states, behind a link of independent losses."""

    taken: NoiseTaken
    slots: int

    @cached_property
    def traces(self) -> Floats:
        """The traces of all slots, (slots,)."""
        traces: Floats = np.trace(self.taken.covariances(self.slots), axis1=1, axis2=2)
        return traces

    @cached_property
    def limit(self) -> float:
        """Trace of the limit; inf if it is unbounded."""
        return float(np.trace(self.taken.limit))

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound: not where noise is used, which leaves an error like x itself."""
        return has_infinite_variance(self.taken.process, self.taken.outcomes)
