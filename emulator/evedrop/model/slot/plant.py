"""The true states of a batch: of a process alone, of a plant that inputs and disturbances move, or given ones.

Source: docs/mathematics.md, model, closed loop and given states.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from evedrop.model.given_states import GivenStates
from evedrop.model.plant import Drive, Plant
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.streams import Batch


class States(NamedTuple):
    """The states of c consecutive slots."""

    x: Floats
    """True states, (c, n, R)."""
    predicted: Floats
    """A x of the slots before, (c, n, R)."""
    pushed: list[Floats] | None = None
    """The effect of inputs and disturbances on each slot's state, (n, R) or (n, 1); None without a plant."""


@final
class PlantCore:
    """Computes the states, in order.

    key: of the stream `process`; initial: as for `Trajectory`; disturbances (slots, q): needed with a plant; given: the states
    themselves, in place of all of these.
    """

    def __init__(
        self,
        process: Process,
        key: bytes,
        batch: Batch,
        initial: Floats | None = None,
        plant: Plant | None = None,
        disturbances: Floats | None = None,
        given: GivenStates | None = None,
    ) -> None:
        self._given = given
        self._trajectory = Trajectory(process, key, batch, initial, None if plant is None else plant.noise)
        self._drive = None if plant is None or disturbances is None else Drive(plant, disturbances)

    def advance(self, slots: range) -> States:
        """The states of the next slots."""
        if self._given is not None:
            return States(*self._given.advance(slots))
        if self._drive is None:
            return States(*self._trajectory.advance_block(len(slots)))
        pushed, x, predicted = [], [], []
        for k in slots:
            pushed.append(self._drive.pushed(k))
            x.append(self._trajectory.advance(pushed[-1]))
            predicted.append(self._trajectory.predicted)
        return States(np.array(x), np.array(predicted), pushed)

    def set_inputs(self, u: Floats) -> None:
        """Apply the inputs u (m, R) from the next slot on, until others come."""
        if self._drive is not None:
            self._drive.set_inputs(u)

    def add_watermark(self, e: Floats) -> None:
        """Add the watermark e, (m, R), to the inputs from the next slot on, until there is another one."""
        if self._drive is not None:
            self._drive.add_watermark(e)

    @property
    def entered(self) -> Floats | None:
        """What the watermark added to the inputs that led into the last slot, (m, R); None if there was none."""
        return None if self._drive is None else self._drive.entered
