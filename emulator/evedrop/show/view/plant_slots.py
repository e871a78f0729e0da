"""The plant's inputs and disturbances and the curves of applications, slot by slot, of the trial that the view shows.

Source: docs/view.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from evedrop.model.integrity.monitor import MonitoredSlots
from evedrop.model.process import Floats
from evedrop.scenario.application import APPLICATIONS, ControlledPlant
from evedrop.scenario.controlled import controlled_plant, labels
from evedrop.scenario.tables import Scenario
from evedrop.show.view.scene import Moved


@final
class LoopValues:
    """Follows one trial of a closed loop, whose slots come in order, and gives the view its values."""

    def __init__(self, loop: ControlledPlant, scenario: Scenario) -> None:
        self._plant, self._disturbances = loop.plant, loop.disturbances
        feeds = [APPLICATIONS[name].feed(loop, table) for name, table in scenario.applications.items()]
        self._feeds = [feed for feed in feeds if feed is not None]
        self._next = 0

    @classmethod
    def of(cls, scenario: Scenario) -> LoopValues | None:
        """An instance for a scenario; None without a controller."""
        loop = controlled_plant(scenario)
        return None if loop is None else cls(loop, scenario)

    def take(self, u: Floats, estimates: Mapping[str, Floats], monitored: MonitoredSlots | None = None) -> Moved:
        """The view's values of the next slots, from inputs as decided, (c, m), and estimates as deviations, (c, n).

        monitored: watermark and detector in this trial alone; None without them.
        """
        limited = self._plant.limited(u.T).T
        first, self._next = self._next, self._next + len(u)
        values = np.hstack([self._disturbances[first : self._next], limited])
        curves: dict[str, Floats] = {}
        for feed in self._feeds:
            if monitored is not None:
                curves |= feed.take_monitored(first, monitored)
            curves |= feed.take(first, limited, estimates)
        return Moved(values, curves)


def driven_scene(scenario: Scenario) -> dict[str, Any]:
    """The entries of `Scene` for a plant with a controller; empty without."""
    plant, process, loop = scenario.plant, scenario.process, controlled_plant(scenario)
    if plant is None or loop is None:
        return {}
    return {
        "states": labels(process.states, process.units),
        "moving": (*loop.disturbance_labels, *labels(plant.inputs, plant.input_units)),
        "panels": tuple(
            panel for name, table in scenario.applications.items() for panel in APPLICATIONS[name].panels(loop, table)
        ),
    }
