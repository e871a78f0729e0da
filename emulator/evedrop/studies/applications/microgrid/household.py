"""The household: a house with a battery and solar cells, its energies, and what receivers can infer about its activity.

Source: docs/scenario.md, household; docs/microgrid.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, final

import numpy as np

from evedrop.model.metrics.text import estimate
from evedrop.model.process import Floats
from evedrop.scenario.application import (
    STANDARD_ERRORS,
    Application,
    ControlledPlant,
    Kind,
    Panel,
    PanelCurve,
    PanelFeed,
    Summary,
)
from evedrop.scenario.table import Table
from evedrop.score.energy import energy
from evedrop.show.view.palette import PLANT, TRUTH_CURVE
from evedrop.studies.applications.microgrid.household_tally import (
    HouseholdTable,
    HouseholdTally,
    HousePower,
    guesses_of,
)
from evedrop.studies.applications.microgrid.privacy import means

if TYPE_CHECKING:
    import pyarrow as pa

ENERGY, GUESSES = "energy", "guesses"
"""Paths of panels."""


@final
class Household(Application):
    """A house behind a meter."""

    table = HouseholdTable
    names: ClassVar[Mapping[str, Kind]] = {
        "grid": "inputs",
        "load": "disturbances",
        "sun": "disturbances",
        "battery": "states",
    }
    metrics = ("bought_energy", "sold_energy", "net_difference", "total_difference", "summed_difference")
    receiver_metrics = ("activity_area", "detection_rate")
    has_power = True
    example = "microgrid"

    @classmethod
    def power(cls, loop: ControlledPlant, table: Table, trials: int) -> HousePower:
        """The grid power."""
        return HousePower(loop, _house(table), trials)

    @classmethod
    def tally(cls, loop: ControlledPlant, table: Table, trials: int) -> HouseholdTally:
        """A tally over no slots yet."""
        return HouseholdTally(loop, _house(table), trials)

    @classmethod
    def lines(cls, summary: Summary) -> list[str]:
        """Energy bought and sold, the cost of secrecy and losses, and what activity receivers detect."""
        seen = {
            **summary["knowing_truth"],
            STANDARD_ERRORS: summary.get(STANDARD_ERRORS, {}).get("knowing_truth", {}),
        }
        lines = [
            f"the house buys {_kwh(summary, 'bought')} kWh and sells {_kwh(summary, 'sold')} kWh; a "
            f"controller that sees the truth, {_kwh(seen, 'bought')} and {_kwh(seen, 'sold')} kWh"
        ]
        fractions = [summary[f"{name}_difference"] for name in ("net", "total", "summed")]
        if None not in fractions:
            errors = [cls.standard_error(summary, (f"{name}_difference",)) for name in ("net", "total", "summed")]
            net, total, summed = (_per_cent(*one) for one in zip(fractions, errors, strict=True))
            lines.append(
                f"grid power differs from that controller's by {net} in net energy, {total} in total, "
                f"{summed} summed slot by slot"
            )
        areas = {name: one["activity_area"] for name, one in summary["receivers"].items()}
        if None not in areas.values():
            told = ", ".join(f"{name} {cls.text(summary, (name, 'activity_area'), '.3f')}" for name in areas)
            windows = f"{summary['active_windows']} active windows of {summary['windows']}"
            lines.append(f"detection of the {windows} (1 is certainty, 0.5 is guessing): {told}")
        return lines

    @classmethod
    def panels(cls, loop: ControlledPlant, table: Table) -> tuple[Panel, ...]:
        """The energies, and the load with every receiver's guess of it."""
        house = _house(table)
        load = means(loop.disturbances[:, loop.disturbance(house.load)], min(loop.period, loop.slots))
        most = float(load.max())  # the panel need not be as high as wrong guesses
        # Points: a guess that jumps appears as a cloud, and hides no other.
        guesses = tuple(PanelCurve(name, drawn="points", width=1.6) for name in loop.receivers)
        return (
            Panel(
                ENERGY, "Energy bought and sold (kWh)", (PanelCurve("bought", PLANT[0]), PanelCurve("sold", PLANT[1]))
            ),
            Panel(
                GUESSES,
                f"{loop.disturbance_labels[loop.disturbance(house.load)]}, and what each would guess from its estimate",
                (PanelCurve("truth", TRUTH_CURVE, "steps", 1.4), *guesses),
                (-0.1 * most, 1.15 * most),
                with_beliefs=True,
            ),
        )

    @classmethod
    def feed(cls, loop: ControlledPlant, table: Table) -> PanelFeed:
        """What fills its panels."""
        return HouseholdFeed(loop, _house(table))

    @classmethod
    def draw_sweep(cls, path: Path, table: pa.Table, key: str) -> None:
        """Draw energies, differences and detection."""
        from evedrop.studies.applications.microgrid.sweep_picture import draw  # noqa: PLC0415 - matplotlib takes half a second

        draw(path, table, key)


@final
class HouseholdFeed(PanelFeed):
    """The energies since slot 0, the load, and the guesses of it, in one trial."""

    def __init__(self, loop: ControlledPlant, table: HouseholdTable) -> None:
        self._period, self._seconds = loop.period, loop.slot_seconds
        self._grid = loop.input(table.grid)
        self._load = loop.disturbances[:, loop.disturbance(table.load)]
        self._guesses = guesses_of(loop, table, 1)
        self._sums: Floats = np.zeros(2)

    def take(self, first: int, u: Floats, estimates: Mapping[str, Floats]) -> Mapping[str, Floats]:
        """Add the next slots."""
        grid, slots = u[:, self._grid], np.arange(first, first + len(u), dtype=np.float64)
        sums = self._sums + np.cumsum(np.stack([np.maximum(grid, 0.0), np.maximum(-grid, 0.0)], axis=1), axis=0)
        self._sums = sums[-1]
        bought, sold = energy(sums, self._seconds).T
        load = self._load[first : first + len(u)]
        return {
            f"{ENERGY}/bought": np.stack([slots, bought]),
            f"{ENERGY}/sold": np.stack([slots, sold]),
            f"{GUESSES}/truth": np.stack([slots, load]),
            **{f"{GUESSES}/{name}": self._guessed(name, first, estimates[name]) for name in self._guesses},
        }

    def _guessed(self, name: str, first: int, estimates: Floats) -> Floats:
        """Guesses, shown from the beginning of the period that they are for, which has ended."""
        pairs = []
        for row in range(-first % self._period, len(estimates), self._period):
            load = self._guesses[name].take(first + row, estimates[row, :, None])
            if load is not None:
                pairs.append((float(first + row - self._period), float(load[0])))
        return np.array(pairs).reshape(-1, 2).T


def _house(table: Table) -> HouseholdTable:
    assert isinstance(table, HouseholdTable)  # noqa: S101 - the hook gives each application its own table
    return table


def _per_cent(fraction: float, error: float | None) -> str:
    return estimate(100.0 * fraction, None if error is None else 100.0 * error, ".2g") + " %"


def _kwh(summary: Summary, way: str) -> str:
    return Household.text(summary, (f"{way}_energy",), ".3f")
