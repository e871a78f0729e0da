"""The secret schedule ν: which packets contain the state and which an innovation."""

from __future__ import annotations

from typing import final

from evedrop.model.receiver import Flags
from evedrop.streams import Ahead, Batch, BlockReader


@final
class Schedule:
    """ν_k for every trial, from the stream `schedule`: P(ν_k = 0) = μ_d for k ≥ 1, and ν_0 = 0.

    Known to sensor and legitimate estimator, and to those eavesdroppers that are defined to know it.

    Source: docs/mathematics.md, model.
    """

    def __init__(self, key: bytes, state_probability: float, batch: Batch) -> None:
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
        innovations = self._reader.uniforms(slots)[:, 0, :] >= self._state_probability
        if slots.start == 0:
            innovations[0] = False
        return innovations
