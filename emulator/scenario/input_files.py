"""The files that a scenario names, read when it is loaded, so that no other process needs them: disturbances, recordings.

Source: docs/scenario.md, plant; docs/links.md, traces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.errors import DisturbanceError, TraceError
from evedrop.model.checks import is_number
from evedrop.model.delays.trace import MOST_DELAYS
from evedrop.model.process import Floats
from evedrop.recordings.disturbance_file import found_file, read_disturbances
from evedrop.recordings.link_recording import LinkRecording
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml


def disturbance_file_located(tables: Mapping[str, Any], folder: Path) -> None:
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


_STAND_IN = "1"  # the outcomes of a recording that cannot be read: later checks then find no further mistake


def recordings_located(tables: Mapping[str, Any], folder: Path) -> None:
    """Replace the name of every recording with its path, in place; folder: that of the scenario."""
    for _, trace in _traces(tables):
        if isinstance(trace.get("file"), str):
            trace["file"] = str(folder / trace["file"])


def read_recordings(tables: Mapping[str, Any]) -> list[str]:
    """Replace `file` and `column` of every trace with the recorded contents, in place. Returns the mistakes, with their paths."""
    mistakes = []
    delays = 0
    slots = tables.get("slots")
    for path, loss in _traces(tables):
        if path.endswith("delay"):
            mistakes += [f"{path}.{entry}: {what}" for entry, what in _replace(loss, "values")]
            before, delays = delays, delays + (len(loss["values"]) if isinstance(loss["values"], list) else 0)
            if before <= MOST_DELAYS < delays:
                mistakes.append(
                    f"{path}.file: is one too many; expected at most {MOST_DELAYS} delays on all links together"
                )
            continue
        source = "outcomes" if "outcomes" in loss else "file"
        wrong = [f"{path}.{entry}: {what}" for entry, what in _replace(loss, "outcomes")]
        mistakes += wrong
        outcomes = loss["outcomes"]
        if wrong:
            loss.pop("once", None)
        elif loss.get("once") is True and isinstance(outcomes, str) and type(slots) is int and len(outcomes) < slots:
            few = f"has {len(outcomes)} outcomes and is read once; expected slots, which is {slots}, or more"
            mistakes.append(f"{path}.{source}: {few}")
    return mistakes


def _traces(tables: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """The path and table of every loss or delay model that is a trace, at any depth."""
    entries = tables.items() if isinstance(tables, dict) else enumerate(tables) if isinstance(tables, list) else ()
    for name, inner in entries:
        if not isinstance(inner, (dict, list)):
            continue
        if name in ("loss", "delay") and isinstance(inner, dict) and inner.get("model") == "trace":
            yield f"{path}{name}", inner
        else:
            yield from _traces(inner, f"{path}{name}.")


def _replace(trace: dict[str, Any], entry: str) -> list[tuple[str, str]]:
    """Put a recording's contents into `entry`, `outcomes` or `values`; returns the mistakes, (entry, description) each."""
    file, column = trace.pop("file", None), trace.pop("column", None)
    if entry in trace:
        extra = "file" if file is not None else "column" if column is not None else None
        return [(extra, f"is given together with {entry}; expected one of them")] if extra else []
    trace[entry] = _STAND_IN if entry == "outcomes" else [0.0]
    if file is None:
        return [("file", 'is missing; expected file = "walk.csv"')]
    wrong = [
        (name, f"is {as_toml(value)}; expected a string")
        for name, value in (("file", file), ("column", column))
        if value is not None and not isinstance(value, str)
    ]
    if wrong:
        return wrong
    try:
        recording = LinkRecording(Path(file))
        if entry == "outcomes":
            trace[entry] = (recording.outcomes(column) + ord("0")).tobytes().decode()
        else:
            delays = recording.delays(column)
            trace[entry] = delays[~np.isnan(delays)].tolist()
            if not trace[entry]:
                return [("file", f"{file} has no delays; expected one for at least one packet")]
    except TraceError as error:
        return [(error.entry, f"{file} {error.what}" if error.entry == "file" else error.what)]
    return []
