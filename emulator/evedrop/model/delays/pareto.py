"""Delays with a heavy tail: mostly short, occasionally very long."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import number_mistakes
from evedrop.model.delays.delay import LONGEST, DelayModel, length_mistakes
from evedrop.model.kernels.elementary import exp, log
from evedrop.model.process import Floats


class Pareto(DelayModel):
    """Delays least · U^(−1/shape), independent: P(delay > d) = (least/d)^shape for d ≥ least.

    Source: docs/mathematics.md, late packets.
    """

    parameters = MappingProxyType({"least": 0.5, "shape": 2.0})
    lengths = ("least",)

    def __init__(self, least: float, shape: float) -> None:
        self._least, self._shape = float(least), float(shape)

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """A length, and a positive shape."""
        return length_mistakes(given, "least") + number_mistakes(given, "shape", 0.1, 1000.0)

    def delays(self, first: int, numbers: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """Each from a uniform number in [0, 1)."""
        stretched: Floats = self._least * exp(log(1.0 - numbers) / -self._shape)
        return np.minimum(LONGEST, stretched)

    def arrived(self, lag: int) -> float | None:
        """1 − (least / (lag + 1))^shape."""
        return 1.0 - (self._least / (lag + 1)) ** self._shape if lag + 1 > self._least else 0.0
