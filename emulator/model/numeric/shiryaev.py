"""Shiryaev's quickest detection of a rise in the loss rate of a link: the probability that it has already happened.

Source: docs/mathematics.md, when noise begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


@final
@dataclass(frozen=True)
class ShiryaevTest:
    """p⁻ = p + (1−p)κ; p ← p⁻ f₁ / (p⁻ f₁ + (1−p⁻) f₀), with an alarm where 1 − p ≤ h.

    f₁ and f₀ are the probabilities of what happened to the packet, with and without the change. Raises ValueError if the second
    rate is not above the first, or if a number is not between 0 and 1.
    """

    normal: float
    """Probability of a loss before the change."""
    raised: float
    """The same after it."""
    hazard: float
    """κ: the probability that the change happens in a slot, if it has not happened before."""
    risk: float
    """h: of all alarms, the share of false ones is at most this, if the change happens as κ says."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        inside = all(0.0 < one < 1.0 for one in (self.normal, self.raised, self.hazard, self.risk))
        if not inside or self.raised <= self.normal:
            raise ValueError(
                f"loss rates {self.normal:g} and {self.raised:g}, hazard {self.hazard:g}, risk {self.risk:g}; expected numbers "
                "between 0 and 1, and a second rate above the first"
            )

    def start(self, trials: int) -> Floats:
        """P before the first slot, (R,)."""
        return np.zeros(trials)

    def step(self, p: Floats, lost: Flags) -> Floats:
        """P after a slot, (R,)."""
        before = p + (1.0 - p) * self.hazard
        changed = before * np.where(lost, self.raised, 1.0 - self.raised)
        same = (1.0 - before) * np.where(lost, self.normal, 1.0 - self.normal)
        found: Floats = changed / (changed + same)
        return found

    def alarms(self, p: Floats) -> Flags:
        """Whether the alarm is raised, (R,)."""
        flags: Flags = 1.0 - p <= self.risk
        return flags
