"""The plant and controller of a scenario, as its applications see them."""

from __future__ import annotations

import numpy as np

from evedrop.model.controllers import CONTROLLERS
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.scenario.application import APPLICATIONS, ControlledPlant
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
        controller.acts_on == "truth",
        tuple((start, min(stop, scenario.slots)) for start, stop in scenario.timeline.spoofs),
    )


def monitor_of(scenario: Scenario) -> MonitorPlan | None:
    """The watermark, detector and attack that an application of the scenario wants; None if none wants any."""
    loop = controlled_plant(scenario)
    plans = [
        APPLICATIONS[name].monitor(loop, table) for name, table in scenario.applications.items() if loop is not None
    ]
    return next((plan for plan in plans if plan is not None), None)
