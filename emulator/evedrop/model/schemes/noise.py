"""Noise in place of the state, by a schedule that sensor and legitimate estimator have arranged in advance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, final

import numpy as np

from evedrop.model.checks import as_toml, is_number, probabilities_mistakes
from evedrop.model.kernels.elementary import cholesky
from evedrop.model.packet_user import PacketUser
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Flags, Receiver
from evedrop.model.schedule import PACKETS, NoiseDistribution, Schedule
from evedrop.model.schemes.scheme import Encoder, PacketBlock, Scheme, Shared
from evedrop.model.streams import Ahead, Batch, BlockReader
from evedrop.model.theory.closed_forms import ReceiverConditions, TakesNoise
from evedrop.model.theory.covariances import Outcomes
from evedrop.model.theory.leaked_bits import RevealedBits


@final
class NoiseEncoder(Encoder):
    """z_k = x_k, or n_k from the stream `noise` where ν_k = 1."""

    def __init__(
        self, process: Process, distribution: NoiseDistribution, schedule: Schedule, key: bytes, batch: Batch
    ) -> None:
        self._schedule = schedule
        factors, reader = distribution.factors(process), BlockReader(key, batch, process.n)
        self._noise = Ahead(reader.ahead, lambda slots: product(factors(slots), reader.normals(slots)))

    def encode_block(self, slots: range, x: Floats, predicted: Floats) -> PacketBlock:  # noqa: ARG002 - no innovation
        """The packets of consecutive slots."""
        nu = self._schedule.block(slots)
        return PacketBlock(np.where(nu[:, None, :], self._noise.of(slots), x), nu)


@final
class NoiseEstimator(PacketUser):
    """Uses every state and ignores the noise."""

    def __init__(self, process: Process, trials: int, schedule: Schedule) -> None:
        super().__init__(process, trials)
        self._schedule = schedule

    def uses_block(self, slots: range) -> Flags | None:
        """Where the packet is the state."""
        return ~self._schedule.block(slots)


@final
class NoiseShared(Shared):
    """The schedule, whose key both sides have, and the noise, which only the sensor draws."""

    def __init__(self, scheme: Noise, keys: Mapping[str, bytes], batch: Batch) -> None:
        self._scheme, self._keys, self._batch = scheme, keys, batch
        self._schedule = Schedule(keys["schedule"], scheme.mu_d, batch)

    def nu(self, k: int) -> Flags:
        """ν_k, (R,): true for noise."""
        return self._schedule.at(k)

    def chi(self, k: int) -> Floats:  # noqa: ARG002 - every slot alike
        """Nothing, (n, R): noise is not decoded."""
        return np.zeros((self._scheme.process.n, self._batch.trials))

    def encoder(self) -> Encoder:
        """The sensor's side."""
        distribution, key = self._scheme.noise_distribution, self._keys["noise"]
        return NoiseEncoder(self._scheme.process, distribution, self._schedule, key, self._batch)

    def estimator(self) -> Receiver:
        """The legitimate estimator's side."""
        return NoiseEstimator(self._scheme.process, self._batch.trials, self._schedule)


def _takes_noise(scheme: Noise, conditions: ReceiverConditions) -> TakesNoise | None:
    received, uses = conditions.received, conditions.uses
    if received is None or uses is None:
        return None
    return TakesNoise(scheme.process, scheme.noise_distribution, scheme.mu_d, received, uses, conditions.slots)


class Noise(Scheme):
    """The state with probability μ_d = `state_probability`, otherwise noise of covariance `noise_covariance`.

    μ_d may be a list with μ_d(k) of each slot; with 1 up to a slot the noise begins after it.

    Noise contains nothing, so an eavesdropper that knew the schedule would be behind only by the quality of its link.

    Source: Crimson, Kennedy, Quevedo (2023); docs/mathematics/schemes.md, noise packets.
    """

    sent_words = ("state", "noise")
    best_reader = "bayesian"
    closed_forms = MappingProxyType(dict.fromkeys(("naive", "suspicious"), _takes_noise))
    parameters = MappingProxyType({"state_probability": 0.6, "noise_covariance": PACKETS})
    secret_streams = ("schedule", "noise")
    estimator_streams = ("schedule",)
    secret_words = (1, 0)

    def __init__(self, process: Process, state_probability: float | Sequence[float], noise_covariance: Any) -> None:
        super().__init__(process, state_probability)
        self._distribution = NoiseDistribution(noise_covariance)

    @property
    def noise_distribution(self) -> NoiseDistribution:
        """N(0, N_k)."""
        return self._distribution

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """μ_d is a probability, or a list of probabilities; the noise has a positive definite covariance."""
        mistakes = probabilities_mistakes(given, "state_probability")
        if (wrong := _mistake(given.get("noise_covariance", PACKETS))) is not None:
            mistakes.append(("noise_covariance", f"is {as_toml(given['noise_covariance'])}{wrong}"))
        return mistakes

    @classmethod
    def mistakes_with(cls, process: Process, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The noise has as many dimensions as the state."""
        rows, n = given["noise_covariance"], process.n
        if rows == PACKETS or len(rows) == n:
            return []
        return [("noise_covariance", f"is {len(rows)} × {len(rows)}; expected {n} × {n}, as A is")]

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """Schedule and noise."""
        return NoiseShared(self, keys, batch)

    def outcomes(self, mu: float) -> Outcomes:
        """A state with probability μμ_d: E P → (1−μμ_d) S(μμ_d)."""
        return Outcomes.eavesdropper(mu, self.state_probability, 1.0, 0.0)

    def revealed_bits(self) -> RevealedBits:
        """The state; noise, which does not depend on it, reveals nothing."""
        return RevealedBits(math.inf, 0.0)

    def eavesdropper_outcomes(self, mu_e: float, use_state: float, use_innovation: float) -> Outcomes | None:
        """None for a receiver that may take noise for the state: `closed_forms` has the effect of that."""
        if use_innovation > 0.0 and self.state_probability < 1.0:
            return None
        return Outcomes.eavesdropper(mu_e, self.state_probability, use_state, use_innovation)

    def bound_outcomes(self, mu_e: float) -> Outcomes:
        """Those of a receiver that knows the schedule: noise is independent of everything, so it has nothing else to learn."""
        return self.outcomes(mu_e)


def _mistake(value: Any) -> str | None:
    """What is wrong with a covariance of noise, after its value; None if nothing is."""
    if value == PACKETS:
        return None
    wanted = f'expected "{PACKETS}", for noise as large as the states, "filter" or a matrix such as [[0.01, 0.0], [0.0, 0.01]]'
    if value == "filter":
        given = "expected output_matrix and measurement_noise in [plant]"
        return f', but the sensor has no filter; {given}, or a matrix, or "{PACKETS}", for noise as large as the states'
    rows = value if isinstance(value, list) and value else [None]
    if not all(isinstance(row, list) and len(row) == len(rows) and all(map(is_number, row)) for row in rows):
        return f"; {wanted}"
    N = np.array(rows, np.float64)
    try:
        cholesky(N)
    except ValueError:
        return ", which is not positive definite; expected a covariance with variance in every direction"
    return None if np.array_equal(N, N.T) else ", which is not symmetric; expected a covariance"
