"""A guess of a house's load, from an estimate of its storage levels and public knowledge.

Between two decisions the inputs are held, so the battery's level moves by the effect of these inputs, by the solar power and
by the load. The solar power is the same on the neighbour's roof. The inputs are secret, but plant and controller are
public, so a copy of the controller, fed with the neighbour's own estimate, reproduces them. The rest of the change in level
is the load.

Source: docs/microgrid.md, privacy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.controllers import Assignment, Controller
from evedrop.model.controllers.lqr import held
from evedrop.model.process import Floats, product

_BELIEVED = 0.9
"""The share of a guess that the copy of the controller is told. A controller that compensates the load at once leaves no
trace in the level, and a copy that is told all of a wrong guess would confirm that guess for ever."""


@dataclass(frozen=True)
class HousePlaces:
    """The places of a house's quantities in its plant: indices of a state and of disturbances."""

    battery: int
    load: int
    sun: int | None


@final
class LoadGuess:
    """Guesses, one for each decision; decisions come in order from slot 0.

    controller: a new copy of the house's; sun: known power in every slot, (slots,).
    """

    def __init__(self, assignment: Assignment, controller: Controller, house: HousePlaces, sun: Floats) -> None:
        self._assignment, self._controller, self._house, self._sun = assignment, controller, house, sun
        self._power, self._driven = held(assignment)
        self._disturbed = held(assignment, assignment.plant.disturbance_matrix)[1]
        self._u: Floats = np.zeros((assignment.plant.inputs, controller.trials))
        self._level: Floats | None = None
        """The level that would be reached without load, (R,)."""

    def take(self, k: int, x_hat: Floats) -> Floats | None:
        """Mean load in kW of the period that ends with slot k, (R,); None at slot 0. x_hat: estimate of the state, (n, R)."""
        house, assignment = self._house, self._assignment
        guess = None
        d = np.zeros((assignment.plant.disturbance_matrix.shape[1], x_hat.shape[1]))
        if self._level is not None:
            guess = (x_hat[house.battery] - self._level) / self._disturbed[house.battery, house.load]
            d[house.load] = _BELIEVED * np.maximum(guess, 0.0)
        shone = self._sun[k : k + assignment.period]
        if house.sun is not None and len(shone):
            d[house.sun] = shone[0]
        self._u = assignment.plant.limited(self._controller.decide(k, x_hat, d))
        level = product(self._power, x_hat) + product(self._driven, self._u)
        if house.sun is not None and len(shone):
            level += self._disturbed[:, house.sun, None] * shone.mean()
        self._level = level[house.battery]
        return guess
