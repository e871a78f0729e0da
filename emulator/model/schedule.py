"""The secret schedule ν: which packets contain the state and which an innovation."""

from __future__ import annotations

from typing import final

from evedrop.model.receiver import Flags
from evedrop.streams import Batch, BlockReader


@final
class Schedule:
    """ν_k for every trial, from the stream `schedule`: P(ν_k = 0) = μ_d for k ≥ 1, and ν_0 = 0.

    Known to sensor and legitimate estimator, and to those eavesdroppers that are defined to know it.

    Source: docs/mathematics.md, model.
    """

    def __init__(self, key: bytes, state_probability: float, batch: Batch) -> None:
        self._reader = BlockReader(key, batch, 1)
        self._state_probability = state_probability
        self._slots = range(0)
        self._innovations: Flags

    def at(self, k: int) -> Flags:
        """ν_k as flags, (R,): true for an innovation."""
        if k not in self._slots:
            self._slots = self._reader.block(k)
            self._innovations = self._reader.uniforms(self._slots)[:, 0, :] >= self._state_probability
            if self._slots.start == 0:
                self._innovations[0] = False
        flags: Flags = self._innovations[k - self._slots.start]
        return flags
