"""The controller from slot to slot: it decides in some slots, and its inputs hold until the next decision.

Source: docs/mathematics.md, closed loop.
"""

from __future__ import annotations

import time
from typing import NamedTuple, final

from evedrop.model.controllers import CONTROLLERS
from evedrop.model.controllers.controller import Assignment
from evedrop.model.process import Floats
from evedrop.model.receiver import Flags


class Decision(NamedTuple):
    """The inputs from a slot on."""

    u: Floats
    """(m, R)."""
    failed: Flags
    """Whether the decision failed, so that the previous inputs stay, (R,)."""
    seconds: float
    """The time that it took."""


@final
class ControllerCore:
    """Decides the inputs of a batch of trials.

    strategy: the controller's name; disturbances (slots, q).
    """

    def __init__(self, strategy: str, assignment: Assignment, disturbances: Floats, trials: int) -> None:
        self._controller = CONTROLLERS[strategy](assignment, trials)
        self._disturbances = disturbances
        self.period = assignment.period
        """It decides in every slot that this number divides."""

    def decide(self, k: int, x: Floats) -> Decision:
        """The decision of slot k, from its state or an estimate of it, (n, R)."""
        began = time.perf_counter()
        u = self._controller.decide(k, x, self._disturbances[k])
        return Decision(u, self._controller.failed, time.perf_counter() - began)
