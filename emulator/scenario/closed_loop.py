"""Mistakes in plant and controller that only show with the process, the legitimate estimator and the events.

Source: docs/scenario.md, plant and controller.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from evedrop.kernels.elementary import semidefinite_factor
from evedrop.model.controllers import CONTROLLERS
from evedrop.names import LEGITIMATE
from evedrop.scenario.plant import ControllerTable, PlantTable, assignment_of, limit_mistakes, plant_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.table import numbers
from evedrop.scenario.tables import LegitimateTable
from evedrop.scenario.words import as_toml, listed


def loop_mistakes(tables: Mapping[str, Any]) -> Iterator[str]:
    """Mistakes in the plant, the controller and `knows_input`, as far as a faulty file can be checked."""
    plant, controller = tables.get("plant"), tables.get("controller")
    if isinstance(controller, Mapping) and not (isinstance(plant, Mapping) and plant.get("inputs")):
        yield (
            "plant: has no inputs, but there is a controller; expected a table [plant] with inputs and input_matrix, or no "
            "[controller]"
        )
    if isinstance(plant, Mapping) and plant.get("inputs") and controller is None:
        names = plant["inputs"]
        inputs = (
            listed(names) if isinstance(names, list) and all(isinstance(one, str) for one in names) else as_toml(names)
        )
        yield f"controller: is missing; expected a table [controller] that decides {inputs}, or a plant without inputs"
    legitimate = tables.get(LEGITIMATE)
    if isinstance(legitimate, Mapping) and legitimate.get("knows_input") is True and controller is None:
        yield f"{LEGITIMATE}.knows_input: is true, but nothing has inputs; expected a [plant] and a [controller], or no such line"
    process = _process(tables)
    if process is not None and isinstance(plant, Mapping):
        yield from _beside_process(plant, process)
        yield from _rows(plant, tables.get("slots"))
        yield from _beside_plant(tables, process)
    if isinstance(controller, Mapping):
        yield from _outages(tables, controller)


def _process(tables: Mapping[str, Any]) -> ProcessTable | None:
    try:
        return ProcessTable.model_validate(tables.get("process"))
    except ValidationError:
        return None


def _beside_process(plant: Mapping[str, Any], process: ProcessTable) -> Iterator[str]:
    n = len(process.A)
    for name in ("input_matrix", "disturbance_matrix", "noise"):
        rows = plant.get(name)
        if rows is None or not numbers(rows):
            continue
        if len(rows) != n:
            yield f"plant.{name}: has {len(rows)} rows; expected {n}, one for each state"
        elif name == "noise":
            yield from _noise_mistakes(rows, n)
    start = plant.get("start")
    inside = {"process.reference": process.around}
    if start is not None and numbers([start]):
        if len(start) != n:
            yield f"plant.start: has {len(start)} entries; expected {n}, one for each state"
        else:
            inside["start"] = start
    for name, what in limit_mistakes(plant, "state", n, "one for each state", inside):
        yield f"{name}: {what}" if name.startswith("process.") else f"plant.{name}: {what}"


def _noise_mistakes(rows: Sequence[Sequence[float]], n: int) -> Iterator[str]:
    if any(len(row) != n for row in rows):
        yield f"plant.noise: has a row that is not of {n} numbers; expected {n} × {n}, as A is"
        return
    noise = np.array(rows, np.float64)
    if not np.array_equal(noise, noise.T):
        yield "plant.noise: is not symmetric; expected a covariance, such as 1e-6 times the identity, or 0"
        return
    try:
        semidefinite_factor(noise)
    except ValueError:
        yield "plant.noise: has an eigenvalue below 0; expected a covariance, such as 1e-6 times the identity, or 0"


def _rows(plant: Mapping[str, Any], slots: Any) -> Iterator[str]:
    rows = plant.get("disturbance_values")
    if plant.get("disturbances") and isinstance(rows, list) and type(slots) is int and 0 < len(rows) < slots:
        yield f"plant.disturbance_values: has {len(rows)} rows; expected slots, which is {slots}, or more"


def _beside_plant(tables: Mapping[str, Any], process: ProcessTable) -> Iterator[str]:
    """Wrong numbers of weights, and the strategy's objections."""
    try:
        rows = tables["plant"].get("disturbance_values")
        few = {"disturbance_values": rows[:1]} if isinstance(rows, list) else {}
        plant = PlantTable.model_validate({**tables["plant"], **few})
        controller = ControllerTable.model_validate(tables.get("controller"))
    except ValidationError:
        return
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
            yield f"controller.{name}: has {len(values)} entries; expected {count}, {why}"
    if wrong or m == 0 or (plant.input_matrix is not None and len(plant.input_matrix) != n):
        return
    if any(values is not None and len(values) != n for values in (plant.start, plant.state_lower, plant.state_upper)):
        return
    if plant.disturbance_matrix is not None and len(plant.disturbance_matrix) != n:
        return
    seconds = tables.get("slot_seconds")
    slot_seconds = float(seconds) if isinstance(seconds, (int, float)) and seconds > 0 else 1.0
    assignment = assignment_of(controller, process.process, plant_of(plant, process.around), slot_seconds)
    for entry, what in CONTROLLERS[controller.strategy].objections(assignment):
        yield f"controller.{entry}: {what}"


def _outages(tables: Mapping[str, Any], controller: Mapping[str, Any]) -> Iterator[str]:
    """The legitimate estimator must be present while the controller waits for its estimate or it waits for the inputs."""
    try:
        knows = LegitimateTable.model_validate(tables.get(LEGITIMATE)).knows_input
    except ValidationError:
        knows = False
    if controller.get("acts_on", "estimate") != "estimate" and not knows:
        return
    why = (
        "the controller acts on its estimate"
        if controller.get("acts_on", "estimate") == "estimate"
        else "it is told the inputs"
    )
    for i, event in enumerate(tables.get("event", []) if isinstance(tables.get("event"), list) else []):
        for kind in ("kill", "pause"):
            if isinstance(event, Mapping) and event.get(kind) == LEGITIMATE:
                yield (
                    f"event.{i}.{kind}: is {LEGITIMATE}, but {why}, and the loop would stand still; expected a cut of its link, "
                    "over which the estimate is carried on"
                )
