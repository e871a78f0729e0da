"""The loop in which the controller sees the truth: the same plant, noise and disturbances, without a link.

It does not simulate them again. All that both loops share cancels in the difference of their states,
e ← A e + B (u − u′), so the other loop is known wherever the states and inputs of this one are, live and in memory.

Source: docs/microgrid.md, energy.
"""

from __future__ import annotations

from typing import final

import numpy as np

from evedrop.model.controllers import Controller
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process


@final
class PerfectLoop:
    """The other loop, slot by slot; slots come in order from 0.

    controller: a new one, used by nothing else; period: slots between its decisions; disturbances: (slots, q).
    """

    def __init__(
        self, process: Process, plant: Plant, controller: Controller, period: int, disturbances: Floats
    ) -> None:
        self._process = process
        self._plant, self._controller, self._period = plant, controller, period
        self._disturbances = disturbances
        self._next = 0
        self._e: Floats = np.zeros((process.n, controller.trials))
        self._u: Floats = np.zeros((plant.inputs, controller.trials))

    def follow(self, x: Floats, u: Floats) -> Floats:
        """The other loop's inputs of the next slot, (m, R), within their limits; x (n, R) and u (m, R): those of this loop."""
        if self._next % self._period == 0:
            decided = self._controller.decide(self._next, x - self._e, self._disturbances[self._next])
            self._u = self._plant.limited(decided)
        apart = self._plant.moved(u) - self._plant.moved(self._u)
        self._e = self._process.predict(self._e) + apart
        self._next += 1
        return self._u
