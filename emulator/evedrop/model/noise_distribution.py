"""The distribution of packets that hold noise in place of a state. It is public; only the slots of the noise are secret.

Source: docs/mathematics.md, noise packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.process import Floats, Process, StateFactors

PACKETS = "packets"
"""As `noise_covariance`: the noise has the covariance of the states that it replaces."""


@final
@dataclass(frozen=True)
class NoiseDistribution:
    """n_k ~ N(0, N_k), independent from slot to slot and of the process. given: `noise_covariance` as a scenario has it."""

    given: Any
    """The rows of N, which is then the same in all slots, or `PACKETS`: N_k = Σ_k."""

    @property
    def covariance(self) -> Floats | None:
        """N, (n, n); None if it is Σ_k. Raises ValueError or TypeError if it is not a matrix of numbers."""
        return None if isinstance(self.given, str) and self.given == PACKETS else np.array(self.given, np.float64)

    def factors(self, process: Process) -> NoiseFactors:
        """The factors of N_k. Raises ValueError if N is not positive definite."""
        N = self.covariance
        return NoiseFactors(process, None if N is None else cholesky(N))


@final
class NoiseFactors:
    """The lower triangular factors of N_k.

    constant: that of N, (n, n); None if N_k = Σ_k. Slots in order are fastest.
    """

    def __init__(self, process: Process, constant: Floats | None) -> None:
        self._states, self._noise, self._constant = StateFactors(process), process.noise_factor, constant

    def block(self, slots: range) -> Floats:
        """The factors of consecutive slots, at least one, (c, n, n); that of slot 0, which is never noise, has no meaning."""
        if self._constant is not None:
            return np.broadcast_to(self._constant, (len(slots), *self._constant.shape))
        carried = self._states.block(slots)
        noise = np.broadcast_to(self._noise, carried.shape)
        return kernels.triangular_factors(np.concatenate([carried, noise], axis=2))
