"""The closed loop of a scenario: its plant and controller as applications see them, and mistakes in them.

The mistakes are those that only show next to process, scheme, legitimate estimator and events. Those in given states are here,
too.

Source: docs/scenario.md, process, plant and controller.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evedrop.counting import counted
from evedrop.model.controllers import CONTROLLERS
from evedrop.model.integrity.monitor import MonitorPlan
from evedrop.model.schemes import SCHEMES
from evedrop.names import LEGITIMATE
from evedrop.scenario.application import APPLICATIONS, ControlledPlant
from evedrop.scenario.input_files import disturbances_of
from evedrop.scenario.plant import ControllerTable, PlantTable, assignment_of, limit_mistakes, noise_mistakes, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.process_noise import measured_mistakes
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import listed


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


def loop_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes in the plant, the controller and `legitimate.knows_input`."""
    plant, controller = scenario.plant, scenario.controller
    if controller is not None and (plant is None or not plant.inputs):
        yield (
            "plant: has no inputs, but there is a controller; expected a table [plant] with inputs and input_matrix, or no "
            "[controller]"
        )
    if plant is not None and plant.inputs and controller is None:
        inputs = listed(plant.inputs)
        yield f"controller: is missing; expected a table [controller] that decides {inputs}, or a plant without inputs"
    if scenario.legitimate.knows_input and controller is None:
        yield f"{LEGITIMATE}.knows_input: is true, but there are no inputs; add a [plant] and a [controller], or remove the line"
    if plant is not None:
        yield from _plant_and_process(plant, scenario.process)
        rows = plant.disturbance_values
        if plant.disturbances and rows and len(rows) < scenario.slots:
            yield f"plant.disturbance_values: has {counted(len(rows), 'row')}; expected slots, which is {scenario.slots}, or more"
        if controller is not None:
            yield from _controller_and_plant(plant, controller, scenario.process, scenario.slot_seconds or 1.0)
    if controller is not None:
        yield from _outages(scenario, controller)


def given_state_mistakes(scenario: Scenario) -> Iterator[str]:
    """Mistakes together with states that come from a recording or a program."""
    process = scenario.process
    if not process.given:
        return
    where = f"process.source: is {process.source}"
    loop = {"plant": scenario.plant, "controller": scenario.controller, **scenario.applications}
    for name, table in loop.items():
        if table is not None:
            yield (
                f"{where}, but there is a [{name}], and nothing here moves such states; expected no [{name}], or no source, "
                "so that states are simulated"
            )
    if scenario.scheme.decides_initial_state():
        able = listed(sorted(name for name in SCHEMES if not SCHEMES[name].decides_initial_state()))
        yield (
            f"encoding.scheme: is {scenario.encoding.scheme}, whose secret decides the first state, and states come from a "
            f"{process.source}; expected {able}"
        )
    if process.source == "zenoh" and scenario.shards > 1:
        yield (
            f"shards: is {scenario.shards}; expected 1: each set of processes has a sensor of its own, and these would take "
            "different states from the program"
        )
    rows = process.state_values
    if process.source == "file" and rows and len(rows) < scenario.slots:
        yield f"process.state_values: has {counted(len(rows), 'row')}; expected slots, which is {scenario.slots}, or more"


def _plant_and_process(plant: PlantTable, process: ProcessTable) -> Iterator[str]:
    n = len(process.A)
    for name, rows in (("input_matrix", plant.input_matrix), ("disturbance_matrix", plant.disturbance_matrix)):
        if rows is not None and len(rows) != n:
            yield f"plant.{name}: has {counted(len(rows), 'row')}; expected {n}, one for each state"
    yield from noise_mistakes(plant, n)
    inside = {"process.reference": process.around}
    if plant.start is not None and len(plant.start) != n:
        yield f"plant.start: has {counted(len(plant.start), 'entry')}; expected {n}, one for each state"
    elif plant.start is not None:
        inside["start"] = plant.start
    limits = limit_mistakes("state", plant.state_lower, plant.state_upper, n, "one for each state", inside)
    for name, sentence in limits:
        yield f"{name}: {sentence}" if name.startswith("process.") else f"plant.{name}: {sentence}"


def _controller_and_plant(
    plant: PlantTable, controller: ControllerTable, process: ProcessTable, slot_seconds: float
) -> Iterator[str]:
    """Weights and limits of wrong length, and the strategy's objections."""
    n, m = len(process.A), len(plant.inputs)
    wrong = False
    for name, count, why in (
        ("state_weights", n, "one for each state"),
        ("input_weights", m, "one for each of inputs"),
        ("rate_weights", m, "one for each of inputs"),
        ("rate_limits", m, "one for each of inputs"),
    ):
        values = getattr(controller, name)
        if values is not None and len(values) != count:
            wrong = True
            yield f"controller.{name}: has {counted(len(values), 'entry')}; expected {count}, {why}"
    if wrong or m == 0 or any(_plant_and_process(plant, process)) or measured_mistakes(plant, n):
        return
    assignment = assignment_of(controller, process.process, plant_of(plant, process.around), slot_seconds)
    for entry, sentence in CONTROLLERS[controller.strategy].objections(assignment):
        yield f"controller.{entry}: {sentence}"


def _outages(scenario: Scenario, controller: ControllerTable) -> Iterator[str]:
    """Outages of a legitimate estimator that the loop waits for: the controller acts on its estimate, or it gets the inputs."""
    if controller.acts_on == "estimate":
        why = "the controller acts on its estimate"
    elif scenario.legitimate.knows_input:
        why = "it waits for the inputs"
    else:
        return
    for i, event in enumerate(scenario.event):
        for act in event.acts():
            if act.effect.present is False and LEGITIMATE in act.names:
                yield (
                    f"event.{i}.{act.entry}: is {LEGITIMATE}, but {why}, and the loop would stand still; expected a cut of its "
                    "link, over which the estimate is carried on"
                )
