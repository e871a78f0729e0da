"""The paper's link: every packet is received with the same probability, independently of all else."""

from __future__ import annotations

import numpy as np

from emulator.model.links.link import Fate, LossModel
from emulator.model.process import Floats
from emulator.model.receiver import Codes


class Bernoulli(LossModel):
    """P(γ_k = 1) = quality, which is μ for the legitimate estimator and μ_e for an eavesdropper.

    Source: docs/mathematics.md, model.
    """

    def __init__(self, quality: float) -> None:
        self.quality = quality

    def fates(self, uniforms: Floats) -> Codes:
        """Delivered where the uniform number is below the quality."""
        lost = uniforms[:, 0, :] >= self.quality
        return lost * np.uint8(Fate.LOST)  # DELIVERED is 0; np.where takes ten times as long
