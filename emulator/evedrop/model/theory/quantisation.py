"""The error of a state that is read from a quantised packet.

Source: docs/mathematics.md, quantised packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.process import Floats, Process
from evedrop.model.theory.covariances import NOBODY, limit, state_covariances


@final
@dataclass(frozen=True)
class QuantisationError:
    """White noise of covariance R_k = fraction · diag(Σ_k): the steps grow with the standard deviations of the states."""

    fraction: float

    @classmethod
    def of(cls, bits: int, standard_deviations: float) -> QuantisationError:
        """That of 2^bits steps over so many standard deviations to either side: Δ²/12 each."""
        return cls(standard_deviations**2 / (3.0 * 4.0**bits))

    def covariances(self, process: Process, slots: int) -> Floats:
        """R_k for k = 0 … slots−1, (slots, n, n); inf from where Σ_k overflows."""
        found: Floats = self._of(state_covariances(process, slots))
        return found

    def limit(self, process: Process) -> Floats:
        """The limit of R_k, (n, n); its diagonal is inf unless A forgets."""
        return self._of(limit(process, NOBODY))

    def _of(self, sigma: Floats) -> Floats:
        found: Floats = np.where(np.eye(sigma.shape[-1], dtype=np.bool_), self.fraction * sigma, 0.0)
        return found
