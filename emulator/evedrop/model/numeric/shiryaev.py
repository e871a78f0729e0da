"""Shiryaev's quickest detection: the probability that a change has already happened, such as a rise in a link's loss rate.

Source: docs/mathematics.md, when noise begins; integrity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


def probability_of_change(p: Floats, hazard: float, changed: Floats, same: Floats | float) -> Floats:
    """p⁻ = p + (1−p)κ, then p⁻ f₁ / (p⁻ f₁ + (1−p⁻) f₀): the probability that the change has happened, (R,), after a slot.

    p: the same before the slot, (R,); hazard: κ; changed, same: f₁ and f₀, (R,), up to a common factor.
    """
    before = p + (1.0 - p) * hazard
    after = before * changed
    found: Floats = after / (after + (1.0 - before) * same)
    return found


@final
@dataclass(frozen=True)
class ShiryaevTest:
    """The test of a link's loss rate by `probability_of_change`, with an alarm where 1 − p ≤ h.

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
    """h: of all alarms, the fraction of false ones is at most this, if the change happens as κ says."""

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
        changed = np.where(lost, self.raised, 1.0 - self.raised)
        return probability_of_change(p, self.hazard, changed, np.where(lost, self.normal, 1.0 - self.normal))

    def alarms(self, p: Floats) -> Flags:
        """Whether the alarm is raised, (R,)."""
        flags: Flags = 1.0 - p <= self.risk
        return flags
