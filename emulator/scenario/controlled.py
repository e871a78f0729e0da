"""The plant and controller of a scenario, as its applications see them."""

from __future__ import annotations

import numpy as np

from evedrop.model.controllers import CONTROLLERS
from evedrop.scenario.application import ControlledPlant
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.tables import Scenario


def labels(names: list[str] | None, units: list[str] | None) -> tuple[str, ...]:
    """Names with their units, if there are units; empty without names."""
    if not names:
        return ()
    return tuple(
        name if units is None else f"{name} ({unit})" for name, unit in zip(names, units or names, strict=True)
    )


def controlled_plant(scenario: Scenario) -> ControlledPlant | None:
    """The plant of a scenario with its controller; None if it lacks either."""
    table, controller, assignment = scenario.plant, scenario.controller, scenario.assignment
    if table is None or controller is None or assignment is None:
        return None
    return ControlledPlant(
        assignment,
        CONTROLLERS[controller.strategy],
        np.array(scenario.process.around),
        disturbances_of(scenario),
        tuple(scenario.process.states or ()),
        tuple(table.inputs),
        tuple(table.disturbances),
        labels(table.disturbances, table.disturbance_units),
        scenario.receivers,
    )
