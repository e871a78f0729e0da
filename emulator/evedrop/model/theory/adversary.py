"""An eavesdropper as the design of μ_d needs to know it, and where its error is bounded.

Source: docs/mathematics.md, design.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evedrop.model.process import Process
from evedrop.model.theory.covariances import Outcomes, limit_trace, stability_bound

ATTAINED = 1e-5
"""A maximum nearer than this to the open end of the interval, relative to its length, is not a maximum."""
_NEAREST = 1e-9  # smallest distance to a pole, relative to the interval, at which differences are computed


@dataclass(frozen=True)
class Adversary:
    """An eavesdropper as the design needs to know it."""

    name: str
    mu_e: float
    """Quality of its link."""
    use_state: float
    """P(b = 1 given ν = 0)."""
    use_innovation: float
    """P(b = 1 given ν = 1)."""
    reads_leak: bool = False
    """Whether it uses the leak of innovations: the genie, with the probabilities of smart."""

    @classmethod
    def with_outcomes(cls, name: str, mu_e: float, half: Outcomes) -> Adversary:
        """From its outcomes behind a lossless link at μ_d = 1/2."""
        return cls(name, mu_e, 2.0 * half.state, 2.0 * half.misled, half.leaked > 0.0)

    def outcomes(self, mu_d: float) -> Outcomes:
        """Its outcomes in a slot."""
        if self.reads_leak:
            return Outcomes.genie(self.mu_e, mu_d)
        return Outcomes.eavesdropper(self.mu_e, mu_d, self.use_state, self.use_innovation)


def adversary_bound(process: Process, adversary: Adversary) -> float:
    """Infimum of the μ_d at which an eavesdropper's error is bounded; inf if there is none.

    The error of an eavesdropper that may be misled is bounded at most at μ_d = 1, where nothing misleads.

    Source: docs/mathematics.md, design.
    """
    bound = stability_bound(process, adversary.mu_e * adversary.use_state)
    if math.isinf(limit_trace(process, adversary.outcomes(0.5))) and adversary.outcomes(0.5).misled:
        return 1.0 if bound < 1.0 else math.inf
    return bound


def traces_of(process: Process, mu: float, adversary: Adversary, mu_d: float) -> tuple[float, float]:
    """J and J_e at μ_d; inf where they are unbounded."""
    ours = limit_trace(process, Outcomes.legitimate(mu, mu_d))
    return ours, limit_trace(process, adversary.outcomes(mu_d))


def points_between(low: float, high: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Points of (low, high], dense near low, where there may be a pole."""
    steps = np.concatenate([np.geomspace(_NEAREST, 0.02, 60), np.linspace(0.02, 1.0, 99)[1:]])
    points: np.ndarray[tuple[int], np.dtype[np.float64]] = low + steps * (high - low)
    return points
