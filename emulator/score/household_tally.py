"""Totals of a house over a run: energy bought and sold, the change by perfect knowledge, and what receivers can infer.

Source: docs/microgrid.md, energy and privacy; docs/results.md, household.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, final

import numpy as np

from evedrop.model import privacy
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.energy import Meter, energy
from evedrop.model.load_guess import HousePlaces, LoadGuess
from evedrop.model.perfect import PerfectLoop
from evedrop.model.process import Floats
from evedrop.scenario import Scenario
from evedrop.scenario.disturbances import disturbances_of
from evedrop.scenario.household import HouseholdTable


def guesses_of(scenario: Scenario, table: HouseholdTable, trials: int) -> dict[str, LoadGuess]:
    """Receiver → the guess of the load from its estimates."""
    plant, controller, assignment = scenario.plant, scenario.controller, scenario.assignment
    assert plant is not None and controller is not None and assignment is not None  # noqa: S101, PT018 - a house has them
    names, strategy = plant.disturbances, CONTROLLERS[controller.strategy]
    sun = None if table.sun is None else names.index(table.sun)
    house = HousePlaces((scenario.process.states or []).index(table.battery), names.index(table.load), sun)
    shone = np.zeros(scenario.slots) if sun is None else disturbances_of(scenario)[:, sun]
    return {name: LoadGuess(assignment, strategy(assignment, trials), house, shone) for name in scenario.receivers}


@final
class HouseholdTally:
    """A house's totals over a set of trials, whose slots come in order."""

    def __init__(self, scenario: Scenario, table: HouseholdTable, trials: int) -> None:
        plant, controller, assignment = scenario.driven, scenario.controller, scenario.assignment
        assert plant is not None and controller is not None and assignment is not None and scenario.plant is not None  # noqa: S101, PT018 - a house has them
        self._table, self._plant = table, plant
        self._slot_seconds = scenario.slot_seconds or 1.0
        self._disturbances = disturbances_of(scenario)
        self._grid = scenario.plant.inputs.index(table.grid)
        self._period = controller.period
        self._window = table.window(self._period * self._slot_seconds)
        strategy = CONTROLLERS[controller.strategy]
        own = strategy(assignment, trials)
        self._perfect = PerfectLoop(scenario.process.process, plant, own, self._period, self._disturbances)
        self._load = scenario.plant.disturbances.index(table.load)
        self._guesses = guesses_of(scenario, table, trials)
        self._guessed: dict[str, list[Floats]] = {name: [] for name in scenario.receivers}
        self.meter = Meter.zero(trials)
        self.done = 0

    @classmethod
    def of(cls, scenario: Scenario, trials: int) -> HouseholdTally | None:
        """The totals of some trials of a scenario; None without a house."""
        return None if scenario.household is None else cls(scenario, scenario.household, trials)

    def add(self, x: Floats, u: Floats, estimates: Mapping[str, Floats]) -> None:
        """Add the next slots: states (c, n, R), inputs as decided (c, m, R), and every receiver's estimates, (c, n, R)."""
        grid, other = np.empty(u[:, 0].shape), np.empty(u[:, 0].shape)
        for row, (state, inputs) in enumerate(zip(x, u, strict=True)):
            other[row] = self._perfect.follow(state, inputs)[self._grid]
            grid[row] = self._plant.limited(inputs)[self._grid]
        self.meter = self.meter.then(grid, other)
        for row in range(-self.done % self._period, len(x), self._period):
            for name, guess in self._guesses.items():
                load = guess.take(self.done + row, estimates[name][row])
                if load is not None:
                    self._guessed[name].append(load)
        self.done += len(x)

    def __getstate__(self) -> dict[str, Any]:
        """The state without the controllers, which may hold objects bound to their process: a copy takes no further slots."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_perfect", "_guesses")}

    @classmethod
    def merged(cls, parts: Sequence[HouseholdTally | None]) -> HouseholdTally | None:
        """The totals of several sets of trials, in order. If some have fewer slots, guesses cover the slots that all have."""
        known = [part for part in parts if part is not None]
        if not known:
            return None
        whole = copy(known[0])
        whole.meter = Meter.of_all([part.meter for part in known])
        whole.done = min(part.done for part in known)
        fewest = min(len(loads) for part in known for loads in part._guessed.values())
        whole._guessed = {}
        for name in known[0]._guessed:
            rows = zip(*(part._guessed[name][:fewest] for part in known), strict=True)
            whole._guessed[name] = [np.concatenate(row) for row in rows]
        return whole

    def summary(self) -> dict[str, Any]:
        """The summary's entry on the house: means over trials; None for figures that do not exist."""
        meter, seconds = self.meter, self._slot_seconds
        apart = meter.difference
        return {
            "bought_energy": _mean(energy(meter.bought, seconds)),
            "sold_energy": _mean(energy(meter.sold, seconds)),
            "knowing_truth": {
                "bought_energy": _mean(energy(meter.other_bought, seconds)),
                "sold_energy": _mean(energy(meter.other_sold, seconds)),
            },
            "net_difference": _mean(apart.net),
            "total_difference": _mean(apart.total),
            "summed_difference": _mean(apart.summed),
            **self._activity(),
        }

    def _activity(self) -> dict[str, Any]:
        """How well each receiver's guesses detect active windows, over the windows that have ended."""
        table = self._table
        load = privacy.means(self._disturbances[:, self._load], self._period)
        periods = min(len(loads) for loads in self._guessed.values())
        active = privacy.active(load[:periods], self._window, table.active_above)
        told = {}
        for name, loads in self._guessed.items():
            figures = np.full((2, 1), np.nan)
            if len(active):
                guesses = privacy.means(np.stack(loads[:periods]), self._window).T
                figures = np.array(
                    [
                        [privacy.area(one, active) for one in guesses],
                        [privacy.detection_rate(one, active, table.false_alarms) for one in guesses],
                    ]
                )
            told[name] = {"activity_area": _mean(figures[0]), "detection_rate": _mean(figures[1])}
        return {"windows": len(active), "active_windows": int(active.sum()), "receivers": told}


def _mean(values: Floats) -> float | None:
    """The mean over trials; None if a trial has no value."""
    mean = float(np.mean(values))
    return mean if np.isfinite(mean) else None
