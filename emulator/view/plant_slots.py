"""The inputs and disturbances of a plant and the energies of a house, slot by slot for the view: of one trial.

Source: docs/view.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from evedrop.model.energy import energy
from evedrop.model.privacy import means
from evedrop.model.process import Floats
from evedrop.scenario import Scenario
from evedrop.scenario.disturbances import disturbances_of
from evedrop.score.household_tally import guesses_of
from evedrop.view.scene import HouseScene, Moved


@final
class Showing:
    """Follows one trial of a closed loop, whose slots come in order."""

    def __init__(self, scenario: Scenario) -> None:
        assert scenario.plant is not None and scenario.controller is not None and scenario.driven is not None  # noqa: S101, PT018 - checked by `of`
        self._plant, self._period = scenario.driven, scenario.controller.period
        self._disturbances = disturbances_of(scenario)
        self._seconds = scenario.slot_seconds or 1.0
        table = scenario.household
        self._grid = None if table is None else scenario.plant.inputs.index(table.grid)
        self._guesses = {} if table is None else guesses_of(scenario, table, 1)
        self._sums: Floats = np.zeros(2)
        self._next = 0

    @classmethod
    def of(cls, scenario: Scenario) -> Showing | None:
        """An instance for a scenario; None without a controller."""
        return None if scenario.plant is None or scenario.controller is None else cls(scenario)

    def take(self, u: Floats, estimates: Mapping[str, Floats]) -> Moved:
        """Add the next slots: inputs as decided, (c, m), and estimates as deviations, (c, n)."""
        limited = self._plant.limited(u.T).T
        first, self._next = self._next, self._next + len(u)
        values = np.hstack([self._disturbances[first : self._next], limited])
        return Moved(values, self._energies(limited), self._guessed(first, estimates))

    def _energies(self, limited: Floats) -> Floats | None:
        if self._grid is None:
            return None
        grid = limited[:, self._grid]
        sums = self._sums + np.cumsum(np.stack([np.maximum(grid, 0.0), np.maximum(-grid, 0.0)], axis=1), axis=0)
        self._sums = sums[-1]
        return energy(sums, self._seconds)

    def _guessed(self, first: int, estimates: Mapping[str, Floats]) -> dict[str, Floats]:
        """Guesses, shown from the beginning of the period that they are for, which has ended."""
        found = {}
        for name, guess in self._guesses.items():
            pairs = []
            for row in range(-first % self._period, len(estimates[name]), self._period):
                load = guess.take(first + row, estimates[name][row, :, None])
                if load is not None:
                    pairs.append((float(first + row - self._period), float(load[0])))
            found[name] = np.array(pairs).reshape(-1, 2).T
        return found


def driven_scene(scenario: Scenario) -> dict[str, Any]:
    """The view's scene entries for a plant with a controller."""
    plant, process, house = scenario.plant, scenario.process, scenario.household
    if plant is None or scenario.controller is None:
        return {}
    disturbances = _labels(plant.disturbances, plant.disturbance_units)
    moving = (*disturbances, *_labels(plant.inputs, plant.input_units))
    shown_house = None
    if house is not None:
        column = plant.disturbances.index(house.load)
        load = means(disturbances_of(scenario)[:, column], min(scenario.controller.period, scenario.slots))
        shown_house = HouseScene(disturbances[column], float(load.max()))
    return {"states": _labels(process.states, process.units), "moving": moving, "house": shown_house}


def _labels(names: list[str] | None, units: list[str] | None) -> tuple[str, ...]:
    """Names with their units, where there are any."""
    if not names:
        return ()
    return tuple(
        name if units is None else f"{name} ({unit})" for name, unit in zip(names, units or names, strict=True)
    )
