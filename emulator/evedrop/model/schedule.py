"""Which packets contain the state, and which an innovation or noise.

The schedule ν is secret. The distribution of packets that hold noise in place of a state is public; only the slots of the noise
are secret.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import numpy as np

from evedrop.model.kernels.current import kernels
from evedrop.model.kernels.elementary import cholesky, sum_in_order
from evedrop.model.process import Floats, Process, StateFactors
from evedrop.model.receiver import Flags
from evedrop.model.streams import Ahead, Batch, BlockReader

StateProbability = float | tuple[float, ...]
"""μ_d, the same for all slots, or μ_d(k) for k = 0, 1, …; that of the last slot also holds for all slots after it."""


def in_slots(mu_d: StateProbability, slots: range) -> Floats:
    """μ_d(k) of consecutive slots, (c,)."""
    if isinstance(mu_d, tuple):
        return np.array([in_slot(mu_d, k) for k in slots], np.float64)
    return np.full(len(slots), mu_d, np.float64)


def in_slot(mu_d: StateProbability, k: int) -> float:
    """μ_d(k)."""
    return mu_d[min(k, len(mu_d) - 1)] if isinstance(mu_d, tuple) else mu_d


def mean_of(mu_d: StateProbability) -> float:
    """The mean over slots k ≥ 1: the packet of slot 0 is always the state."""
    if not isinstance(mu_d, tuple):
        return mu_d
    later = mu_d[1:] or mu_d
    return sum_in_order(later) / len(later)


def equal_slots(mu_d: StateProbability, slots: range) -> list[range]:
    """Consecutive slots in parts, in order; within a part, μ_d is constant."""
    if not isinstance(mu_d, tuple):
        return [slots]
    inner = [k for k in slots[1:] if in_slot(mu_d, k) != in_slot(mu_d, k - 1)]
    return [range(*part) for part in pairwise([slots.start, *inner, slots.stop])]


@final
class Schedule:
    """ν_k for every trial, from the stream `schedule`: P(ν_k = 0) = μ_d(k) for k ≥ 1, and ν_0 = 0.

    Known to sensor and legitimate estimator, and to those eavesdroppers that are defined to know it.

    Source: docs/mathematics/model.md, model.
    """

    def __init__(self, key: bytes, state_probability: StateProbability, batch: Batch) -> None:
        self._reader = BlockReader(key, batch, 1)
        self._state_probability = state_probability
        self._innovations = Ahead(self._reader.ahead, self._drawn)

    def at(self, k: int) -> Flags:
        """ν_k as flags, (R,): true for an innovation."""
        return self._innovations.at(k)

    def block(self, slots: range) -> Flags:
        """ν of consecutive slots, (c, R)."""
        return self._innovations.of(slots)

    def _drawn(self, slots: range) -> Flags:
        innovations = self._reader.uniforms(slots)[:, 0, :] >= in_slots(self._state_probability, slots)[:, None]
        if slots.start == 0:
            innovations[0] = False
        return innovations


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

    def factors(self, process: Process) -> Callable[[range], Floats]:
        """Gives the lower triangular factors of N_k in consecutive slots, at least one, (c, n, n); slots in order are fastest.

        That of slot 0, which is never noise, has no meaning. Raises ValueError if N is not positive definite.
        """
        N = self.covariance
        if N is None:
            return state_factors(process)
        constant = cholesky(N)
        return lambda slots: np.broadcast_to(constant, (len(slots), *constant.shape))


def state_factors(process: Process) -> Callable[[range], Floats]:
    """Gives lower triangular factors of Σ_k in consecutive slots k ≥ 1, at least one, (c, n, n); slots in order are fastest."""
    states = StateFactors(process)

    def block(slots: range) -> Floats:
        carried = states.block(slots)
        noise = np.broadcast_to(process.noise_factor, carried.shape)
        return kernels.triangular_factors(np.concatenate([carried, noise], axis=2))

    return block
