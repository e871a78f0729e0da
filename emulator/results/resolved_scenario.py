"""The scenario of a run in its results folder: complete, with the versions that made it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path

import tomli_w

from evedrop.plugins import sources_of
from evedrop.recordings.disturbance_file import disturbances_text
from evedrop.results.folder import write_private
from evedrop.scenario import Scenario

DISTURBANCES = "disturbances.csv"
"""The file in a results folder if its scenario has disturbances."""


def write_resolved(folder: Path, scenario: Scenario) -> None:
    """Write the scenario.toml of a results folder, and its disturbances; both files are complete at any moment."""
    texts = {"scenario.toml": resolved(scenario)}
    plant = scenario.plant
    if plant is not None and plant.disturbance_values:
        texts = {
            DISTURBANCES: disturbances_text(plant.disturbances, plant.disturbance_units, plant.disturbance_values),
            **texts,
        }
    for name, text in texts.items():
        unfinished = folder / f"{name}.new"
        write_private(unfinished, text)
        os.replace(unfinished, folder / name)


def resolved(scenario: Scenario) -> str:
    """The complete scenario as TOML, with the versions that made it: running it again gives the same digests."""
    tables = scenario.model_dump(mode="json", exclude_none=True)
    if scenario.plant is not None and tables["plant"].pop("disturbance_values", None):
        tables["plant"]["disturbance_file"] = DISTURBANCES
    if scenario.secret_file is not None:
        tables["secret_file"] = str(Path(scenario.secret_file).absolute())
    tables["made_with"] = {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("evedrop", "numpy", "cryptography", "eclipse-zenoh")},
        **sources_of(tables),
    }
    text: str = tomli_w.dumps(tables)
    return text
