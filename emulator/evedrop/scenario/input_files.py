"""The files that a scenario names, read when it is loaded, so that no other process needs them: states, disturbances, traces.

Source: docs/scenario.md, process and plant; docs/links.md, traces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.errors import DisturbanceError, TraceError, UsageError
from evedrop.model.checks import is_number
from evedrop.model.delays import DELAY_MODELS, MOST_DELAYS, DelayModel
from evedrop.model.links import LOSS_MODELS
from evedrop.model.links.loss_model import LossModel
from evedrop.model.process import Floats
from evedrop.model.slot.cores import deviations
from evedrop.scenario.recordings.disturbance_file import found_file, read_disturbances
from evedrop.scenario.recordings.link_recording import LinkRecording
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import as_toml

_TABLES = {"plant": ("disturbance", "disturbances", "disturbance_units"), "process": ("state", "states", "units")}
"""Table that may name a file of numbers → the first word of its entries, and its entries with names and units."""


def _tables_with_files(tables: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """The tables that name a file of numbers: its name, the first word of its file entries, and the table."""
    for name, (kind, *_) in _TABLES.items():
        table = tables.get(name)
        if isinstance(table, dict) and isinstance(table.get(f"{kind}_file"), str):
            yield name, kind, table


def named_files(tables: Mapping[str, Any]) -> Iterator[str]:
    """The names of all files of states, disturbances and recordings in tables whose files were not located yet."""
    for _, kind, table in _tables_with_files(tables):
        yield table[f"{kind}_file"]
    for _, trace, _ in _recorded(tables):
        if isinstance(trace.get("file"), str):
            yield trace["file"]


def locate_tables(tables: Mapping[str, Any], folder: Path) -> None:
    """Replace the names of the files of states and disturbances with their paths, in place; folder: that of the scenario."""
    for _, kind, table in _tables_with_files(tables):
        table[f"{kind}_file"] = str(found_file(table[f"{kind}_file"], folder))


def read_tables(tables: Mapping[str, Any]) -> list[str]:
    """Replace the names of the files of states and disturbances with the numbers in them, in place.

    A file of states is left alone unless states come from it. Returns the mistakes, with their paths.
    """
    mistakes = []
    for name, kind, table in _tables_with_files(tables):
        if kind != "state" or table.get("source") == "file":
            labels = (table.get(label) for label in _TABLES[name][1:])
            mistakes += [f"{name}.{kind}_file: {sentence}" for sentence in _read(tables, table, kind, *labels)]
    return mistakes


def _read(tables: Mapping[str, Any], table: dict[str, Any], kind: str, names: object, units: object) -> list[str]:
    """Replace the name of one file; `kind`: the first word of its entries in the table."""
    file, values = table.pop(f"{kind}_file"), f"{kind}_values"
    if values in table:
        return [f"is given together with {values}; expected one of them"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        names = []
    if kind == "state" and not names:  # which is a mistake of its own
        table[values] = []
        return []
    slots, seconds = tables.get("slots"), tables.get("slot_seconds")
    if not isinstance(units, list) or not all(isinstance(unit, str) for unit in units):
        units = None
    slots = slots if type(slots) is int and slots > 0 else None
    seconds = float(seconds) if seconds and is_number(seconds, 0.0, 1e6) else 1.0
    try:
        table[values] = read_disturbances(
            found_file(file, Path()), names, units, slots, seconds, recorded=kind == "state"
        )
    except DisturbanceError as error:
        table[values] = []
        return [f"{file} {sentence}" for sentence in error.mistakes]
    return []


def states_of(scenario: Scenario) -> Floats | None:
    """The given states of every slot, as deviations from the reference, (slots, n); None if they are simulated.

    Raises UsageError if they come from a program: only a live run can take them.
    """
    process = scenario.process
    if process.source == "zenoh":
        raise UsageError(
            "process.source: is zenoh, and only a live run can take states from a program; give `evedrop run`, then use its "
            'results folder, whose states are recorded, or give source = "file"'
        )
    if process.source != "file":
        return None
    return deviations(np.array((process.state_values or [])[: scenario.slots]), np.array(process.around))


def disturbances_of(scenario: Scenario) -> Floats:
    """The disturbances of every slot, (slots, q); q is 0 for a scenario without disturbances."""
    table = scenario.plant
    if table is None or not table.disturbances:
        return np.zeros((scenario.slots, 0))
    return np.array((table.disturbance_values or [])[: scenario.slots])


_PLACEHOLDER = "1"  # the outcomes of a recording that cannot be read: later checks then find no further mistake


def locate_recordings(tables: Mapping[str, Any], folder: Path) -> None:
    """Replace the name of every recording with its path, in place; folder: that of the scenario."""
    for _, trace, _ in _recorded(tables):
        if isinstance(trace.get("file"), str):
            trace["file"] = str(folder / trace["file"])


def read_recordings(tables: Mapping[str, Any]) -> list[str]:
    """Replace the file and column of every trace with the recorded contents, in place. Returns the mistakes, with their paths."""
    mistakes = []
    delays = 0
    slots = tables.get("slots")
    for path, trace, model in _recorded(tables):
        parameter = str(model.recorded)
        given, of_delays = parameter in trace, path.endswith("delay")
        wrong = [f"{path}.{entry}: {sentence}" for entry, sentence in _replace(trace, model, of_delays)]
        mistakes += wrong
        contents = trace[parameter]
        if of_delays:
            before, delays = delays, delays + (len(contents) if isinstance(contents, list) else 0)
            if before <= MOST_DELAYS < delays:
                mistakes.append(
                    f"{path}.file: is one too many; expected at most {MOST_DELAYS} delays on all links together"
                )
            continue
        if wrong:
            trace.pop("once", None)
        elif trace.get("once") is True and isinstance(contents, str) and type(slots) is int and len(contents) < slots:
            few = f"has {len(contents)} outcomes and is read once; expected slots, which is {slots}, or more"
            mistakes.append(f"{path}.{parameter if given else 'file'}: {few}")
    return mistakes


def _recorded(tables: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any], type[LossModel | DelayModel]]]:
    """Path and table of every loss or delay model that reads a recording, at any depth, and its class."""
    entries = tables.items() if isinstance(tables, dict) else enumerate(tables) if isinstance(tables, list) else ()
    for name, inner in entries:
        if not isinstance(inner, (dict, list)):
            continue
        model = _reader_of(name, inner) if isinstance(inner, dict) else None
        if isinstance(inner, dict) and model is not None:
            yield f"{path}{name}", inner, model
        else:
            yield from _recorded(inner, f"{path}{name}.")


def _reader_of(entry: str | int, table: Mapping[str, Any]) -> type[LossModel | DelayModel] | None:
    """The class of a built-in loss or delay model that reads a recording; None for any other table."""
    models: Mapping[str, type[LossModel | DelayModel]]
    models = LOSS_MODELS if entry == "loss" else DELAY_MODELS if entry == "delay" else {}
    name = table.get("model")
    model = models[name] if isinstance(name, str) and name in {*models} else None
    return None if model is None or model.recorded is None else model


def _replace(trace: dict[str, Any], model: type[LossModel | DelayModel], of_delays: bool) -> list[tuple[str, str]]:
    """Put a recording's outcomes, or its delays, into their entry; returns the mistakes, (entry, description) each."""
    entry = str(model.recorded)
    file, column = trace.pop("file", None), trace.pop("column", None)
    lost = None if of_delays else trace.pop("lost", None)
    names = (("file", file), ("column", column), ("lost", lost))
    if entry in trace:
        extra = next((name for name, value in names if value is not None), None)
        return [(extra, f"is given together with {entry}; expected one of them")] if extra else []
    misnamed = set(trace) - {"model", *model.parameters}  # perhaps the file, and a mistake of its own
    trace[entry] = [0.0] if of_delays else _PLACEHOLDER
    if file is None:
        return [] if misnamed else [("file", f'is missing; expected file = "walk.csv", or {entry}')]
    wrong = [
        (name, f"is {as_toml(value)}; expected a string")
        for name, value in names
        if value is not None and not isinstance(value, str)
    ]
    if wrong:
        return wrong
    try:
        recording = LinkRecording(Path(file))
        if of_delays:
            delays = recording.delays(column)
            trace[entry] = delays[~np.isnan(delays)].tolist()
            if not trace[entry]:
                return [("file", f"{file} has no delays; expected one for at least one packet")]
        else:
            trace[entry] = (recording.outcomes(column, lost) + ord("0")).tobytes().decode()
    except TraceError as error:
        return [(error.entry, f"{file} {error.reason}" if error.entry == "file" else error.reason)]
    return []
