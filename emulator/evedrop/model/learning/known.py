"""What a learner is told about the process, and what it assumes about the rest.

Source: docs/mathematics.md, eavesdroppers that learn.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evedrop.model.checks import as_toml
from evedrop.model.kernels.elementary import Floats, cholesky
from evedrop.model.kernels.factored import Factor, Factors
from evedrop.model.learning.posterior import Parameters
from evedrop.model.process import Process

KNOWABLE = ("A", "Q", "mu_d", "initial_covariance")
"""What it may be given."""


@dataclass(frozen=True)
class Known:
    """What an eavesdropper knows about the process, and what it assumes about the rest."""

    names: frozenset[str]
    """Those of A, Q, mu_d and initial_covariance that it knows."""
    A: Floats
    """(n, n); I if it is not known."""
    noise: Factors
    """Q, of one matrix, (1,) matrices; anything if it is not known."""
    mu_d: float
    """1/2 if it is not known."""
    initial: Factors
    """Σ0, as Q; the variance of the first packets replaces it if it is not known."""

    @property
    def sigma(self) -> bool:
        """Whether it knows Σ_k of every slot."""
        return self.names >= {"A", "Q", "initial_covariance"}

    @property
    def everything(self) -> bool:
        """Whether it has nothing to learn."""
        return self.names >= {"A", "Q", "mu_d"}

    def start(self, variance: Floats) -> Parameters:
        """The parameters that are known, and where they are not A = I, a Q of some variance (R,), and μ_d = 1/2."""
        trials = len(variance)
        noise = Factors(*(np.repeat(part, trials, axis=-1) for part in self.noise))
        if "Q" not in self.names:
            noise = Factors(np.zeros_like(noise.lower), np.repeat(variance[None], len(noise.diagonal), axis=0))
        return Parameters(np.repeat(self.A[:, :, None], trials, axis=2), *noise, np.full(trials, self.mu_d))


def known(process: Process, state_probability: float, knows: Iterable[str]) -> Known:
    """What an eavesdropper is told; state_probability: μ_d; knows: names among `KNOWABLE`."""
    names = frozenset(knows)
    one = np.eye(process.n)

    def factors(name: str, M: Floats) -> Factors:
        return Factors.alike(Factor.of_triangular(cholesky(M if name in names else one).tolist()), (1,))

    return Known(
        names,
        process.A if "A" in names else one,
        factors("Q", process.Q),
        state_probability if "mu_d" in names else 0.5,
        factors("initial_covariance", process.initial_covariance),
    )


def knowing_mistakes(given: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A mistake in `knows`."""
    names = given.get("knows", [])
    if isinstance(names, (list, tuple)) and all(isinstance(name, str) and name in KNOWABLE for name in names):
        return []
    return [("knows", f"is {as_toml(names)}; expected a list of names among {as_toml(list(KNOWABLE))}, or []")]
