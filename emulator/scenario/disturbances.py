"""The disturbances of a scenario's plant: read when the scenario is loaded, so that no other process needs the file.

Source: docs/scenario.md, plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.errors import DisturbanceError
from evedrop.model.links.checks import is_number
from evedrop.model.process import Floats
from evedrop.recordings.disturbance_file import found_file, read_disturbances
from evedrop.scenario.tables import Scenario


def disturbances_beside(tables: Mapping[str, Any], folder: Path) -> None:
    """Replace the name of the disturbance file with its path, in place; folder: that of the scenario."""
    plant = tables.get("plant")
    if isinstance(plant, dict) and isinstance(plant.get("disturbance_file"), str):
        plant["disturbance_file"] = str(found_file(plant["disturbance_file"], folder))


def disturbances_read(tables: Mapping[str, Any]) -> list[str]:
    """Replace the name of the disturbance file with the numbers in it, in place. Returns the mistakes, with their paths."""
    plant = tables.get("plant")
    if not isinstance(plant, dict) or not isinstance(plant.get("disturbance_file"), str):
        return []
    if "disturbance_values" in plant:
        del plant["disturbance_file"]
        return ["plant.disturbance_file: is given together with disturbance_values; expected one of them"]
    names = plant.get("disturbances")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        names = []
    units, slots, seconds = plant.get("disturbance_units"), tables.get("slots"), tables.get("slot_seconds")
    if not isinstance(units, list) or not all(isinstance(unit, str) for unit in units):
        units = None
    slots = slots if type(slots) is int and slots > 0 else None
    seconds = float(seconds) if seconds and is_number(seconds, 0.0, 1e6) else 1.0
    file = plant.pop("disturbance_file")
    try:
        plant["disturbance_values"] = read_disturbances(found_file(file, Path()), names, units, slots, seconds)
    except DisturbanceError as error:
        plant["disturbance_values"] = []
        return [f"plant.disturbance_file: {file} {what}" for what in error.mistakes]
    return []


def disturbances_of(scenario: Scenario) -> Floats:
    """The disturbances of every slot, (slots, q); q is 0 for a scenario without disturbances."""
    table = scenario.plant
    if table is None or not table.disturbances:
        return np.zeros((scenario.slots, 0))
    return np.array((table.disturbance_values or [])[: scenario.slots])
