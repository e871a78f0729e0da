"""The energy bought and sold over a run, and its difference between two runs: the price of a link or of secrecy.

Powers are in kW, positive where it is bought, slot by slot along the first axis; trials may follow.
Source: docs/microgrid.md, energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.process import Floats

_HOUR = 3600.0


@dataclass(frozen=True)
class EnergyDifference:
    """The difference of a run's grid power from another run's, as fractions of the other's, per trial (…)."""

    net: Floats
    """The difference of net energy: |Σ P − Σ P′| / |Σ P′|."""
    total: Floats
    """The relative difference of the energy through the meter in both directions: |Σ |P| − Σ |P′|| / Σ |P′|."""
    summed: Floats
    """The sum of the differences of single slots: Σ |P − P′| / Σ |P′|. At least as large as both others, divided by Σ |P′|."""


@final
@dataclass(frozen=True)
class Meter:
    """Sums over slots of a run's grid power P and of another run's P′, (…) each, in kW."""

    bought: Floats
    sold: Floats
    other_bought: Floats
    other_sold: Floats
    apart: Floats
    """Σ |P − P′|."""

    @classmethod
    def over(cls, grid_power: Floats, other: Floats) -> Meter:
        """The sums of some slots; both arguments (slots, …)."""
        return cls.zero(*grid_power.shape[1:]).then(grid_power, other)

    @classmethod
    def zero(cls, *shape: int) -> Meter:
        """The sums of no slots; shape: that of (…)."""
        return cls(*(np.zeros(shape) for _ in range(5)))

    def then(self, grid_power: Floats, other: Floats) -> Meter:
        """These sums plus those of the next slots, both (slots, …): the same bits however the slots are divided."""
        other = np.broadcast_to(other, grid_power.shape)
        more = (
            np.maximum(grid_power, 0.0),
            np.maximum(-grid_power, 0.0),
            np.maximum(other, 0.0),
            np.maximum(-other, 0.0),
            np.abs(grid_power - other),
        )
        # numpy's sum adds in an order of its own, and the differences between such sums are small.
        sums = (np.add.accumulate([mine, *rows])[-1] for mine, rows in zip(self._sums, more, strict=True))
        return Meter(*sums)

    @classmethod
    def of_all(cls, parts: list[Meter]) -> Meter:
        """The sums of several sets of trials, in order."""
        return cls(*(np.concatenate(sums) for sums in zip(*(part._sums for part in parts), strict=True)))

    @property
    def _sums(self) -> tuple[Floats, ...]:
        return self.bought, self.sold, self.other_bought, self.other_sold, self.apart

    @property
    def difference(self) -> EnergyDifference:
        """The three measures. A fraction of a sum that is 0 is infinite, or NaN if both sums are 0."""
        net, other_net = self.bought - self.sold, self.other_bought - self.other_sold
        total, other_total = self.bought + self.sold, self.other_bought + self.other_sold
        with np.errstate(divide="ignore", invalid="ignore"):
            return EnergyDifference(
                np.abs(net - other_net) / np.abs(other_net),
                np.abs(total - other_total) / other_total,
                self.apart / other_total,
            )


def energy(summed_power: Floats, slot_seconds: float) -> Floats:
    """Energy in kWh from a sum over slots of a power in kW."""
    return summed_power * (slot_seconds / _HOUR)
