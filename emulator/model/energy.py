"""What a house buys and sells over a run, and by how much two runs of it differ: the price of a link, and of secrecy.

Powers are in kW, positive where the house takes from the grid, slot by slot along the first axis; trials may follow.
Source: docs/microgrid.md, energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.model.process import Floats

_HOUR = 3600.0


@dataclass(frozen=True)
class Difference:
    """By how much a run's grid power differs from another's, as shares of the other's, per trial (…)."""

    net: Floats
    """Of the net energy: |Σ P − Σ P′| / |Σ P′|."""
    total: Floats
    """Of the energy that crosses the meter, either way: |Σ |P| − Σ |P′|| / Σ |P′|."""
    summed: Floats
    """Slot by slot: Σ |P − P′| / Σ |P′|. Never below the two others, as shares of the same Σ |P′|."""


def bought(grid_power: Floats, slot_seconds: float) -> Floats:
    """Energy taken from the grid in kWh, (…); grid_power: (slots, …)."""
    return _energy(np.maximum(grid_power, 0.0), slot_seconds)


def sold(grid_power: Floats, slot_seconds: float) -> Floats:
    """Energy given to the grid in kWh, (…), not negative; grid_power: (slots, …)."""
    return _energy(np.maximum(-grid_power, 0.0), slot_seconds)


def difference(grid_power: Floats, reference: Floats) -> Difference:
    """The three measures, (…); grid_power: (slots, …), reference: of the other run, the same shape or (slots,).

    Where the reference's sum is 0 a share of it is infinite, or NaN if both are 0.
    """
    other = reference.reshape(reference.shape + (1,) * (grid_power.ndim - reference.ndim))
    magnitude = np.abs(other).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Difference(
            np.abs(grid_power.sum(axis=0) - other.sum(axis=0)) / np.abs(other.sum(axis=0)),
            np.abs(np.abs(grid_power).sum(axis=0) - magnitude) / magnitude,
            np.abs(grid_power - other).sum(axis=0) / magnitude,
        )


def _energy(power: Floats, slot_seconds: float) -> Floats:
    energy: Floats = np.asarray(power.sum(axis=0) * (slot_seconds / _HOUR))
    return energy
