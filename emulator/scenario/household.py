"""`[household]`: which of a plant's quantities are a house's grid, load, sun and battery, and when the house is active.

Source: docs/scenario.md, household.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import Field

from evedrop.scenario.table import Table
from evedrop.scenario.words import as_toml, listed

FIGURES = ("bought_energy", "sold_energy", "net_difference", "total_difference", "summed_difference")
"""The figures of the house."""
RECEIVER_FIGURES = ("activity_area", "detection_rate")
"""The figures of what a receiver can infer about the house."""
HOUSEHOLD = "household"

Name = Annotated[str, Field(strict=True, min_length=1)]


class HouseholdTable(Table):
    """`[household]`: names of the plant's inputs, disturbances and states, powers in kW."""

    grid: Annotated[Name, Field(examples=["P_grid"])]
    load: Annotated[Name, Field(examples=["P_load"])]
    battery: Annotated[Name, Field(examples=["SOC"])]
    sun: Annotated[Name | None, Field(examples=["P_solar"])] = None
    window_seconds: Annotated[float, Field(strict=True, gt=0.0, le=1e6, examples=[60.0])] = 60.0
    active_above: Annotated[float, Field(strict=True, gt=0.0, le=1e6, examples=[0.7])] = 0.7
    false_alarms: Annotated[float, Field(strict=True, gt=0.0, lt=1.0, examples=[0.05])] = 0.05

    def window(self, period_seconds: float) -> int:
        """The number of decisions in a window, at least 1; a decision lasts period_seconds."""
        return max(1, round(self.window_seconds / period_seconds))


def household_mistakes(tables: Mapping[str, Any]) -> Iterator[str]:
    """Names that the plant does not have, and a house without a plant or a controller."""
    house = tables.get(HOUSEHOLD)
    if not isinstance(house, Mapping):
        return
    plant, process = tables.get("plant"), tables.get("process")
    if not isinstance(plant, Mapping) or not isinstance(tables.get("controller"), Mapping):
        yield f"{HOUSEHOLD}: is given without a [plant] and a [controller], which it describes; expected both, or no such table"
        return
    known = {
        "grid": ("plant.inputs", plant.get("inputs")),
        "load": ("plant.disturbances", plant.get("disturbances")),
        "sun": ("plant.disturbances", plant.get("disturbances")),
        "battery": ("process.states", process.get("states") if isinstance(process, Mapping) else None),
    }
    for entry, (where, names) in known.items():
        name = house.get(entry)
        if not isinstance(name, str):
            continue
        there = [one for one in names if isinstance(one, str)] if isinstance(names, list) else []
        if name not in there:
            choice = f"expected one of {listed(there)}" if there else f"expected {where} = [{as_toml(name)}, …]"
            yield f"{HOUSEHOLD}.{entry}: is {as_toml(name)}, which is not among {where}; {choice}"
    if HOUSEHOLD in (tables.get("eavesdroppers") or {}):
        yield f"eavesdroppers.{HOUSEHOLD}: is a name that the house's figures use; expected another"
