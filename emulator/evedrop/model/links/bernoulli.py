"""The paper's link: every packet is received with the same probability, independently of everything else."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from evedrop.model.checks import probability_mistakes
from evedrop.model.links.loss_model import Chain, LossModel, fates_of
from evedrop.model.process import Floats
from evedrop.model.receiver import Codes


class Bernoulli(LossModel):
    """P(γ_k = 1) = quality, which is μ for the legitimate estimator and μ_e for an eavesdropper.

    Source: docs/mathematics.md, model.
    """

    parameters = MappingProxyType({"quality": 0.9})

    def __init__(self, quality: float) -> None:
        self._quality = quality

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The quality is a probability."""
        return probability_mistakes(given, "quality")

    @property
    def quality(self) -> float:
        """The parameter."""
        return self._quality

    @property
    def chain(self) -> Chain:
        """A single state."""
        return Chain(np.ones((1, 1)), np.ones(1), np.array([self._quality]))

    def fates(self, first: int, uniforms: Floats) -> Codes:  # noqa: ARG002 - every slot alike
        """Delivered where the uniform number is below the quality."""
        return fates_of(uniforms[:, 0, :] >= self._quality)
