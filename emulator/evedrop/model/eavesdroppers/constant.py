"""The constant eavesdropper, which does not listen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evedrop.model.eavesdroppers.eavesdropper import PacketTaker
from evedrop.model.receiver import Flags


class ConstantEstimate(PacketTaker):
    """b_k = 0 always: x̂ = 0 and P = Σ_k. An eavesdropper with a larger error would do better not to listen.

    Source: docs/mathematics.md, eavesdroppers.
    """

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:  # noqa: ARG003 - it has none
        """Never."""
        return 0.0, 0.0

    def uses(self, k: int) -> Flags | None:  # noqa: ARG002 - every slot alike
        """Never."""
        return np.zeros(self.trials, np.bool_)
