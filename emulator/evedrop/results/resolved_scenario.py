"""What a run was made from, in its results folder: its complete scenario, the versions that made it, and its input files.

Source: docs/programs.md, the recorded run.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np

from evedrop.model.process import Floats
from evedrop.results.folder import STATES, replace_private
from evedrop.scenario.plugins import sources_of
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.recordings.disturbance_file import number_lines, table_head, table_text
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import toml_text
from evedrop.system.files import LineFile


@final
class TakenStates:
    """Writes the levels of the states, as a scenario's `state_file` has them; lines are held back until `write`."""

    def __init__(self, folder: Path, process: ProcessTable) -> None:
        """Raises OSError if the file cannot be written."""
        self._around = np.array(process.around)
        self._file = LineFile(folder / STATES)
        self._held: list[str] = [] if self._file.size else [table_head(process.states or (), process.units)]

    def add(self, x: Floats) -> None:
        """Add the states of the next slots, as deviations from the reference, (c, n)."""
        rows: Sequence[Sequence[float]] = (x + self._around).tolist()
        self._held.append(number_lines(rows))

    def write(self) -> None:
        """Write all lines that are held back. Raises OSError if they cannot be written, and leaves the file as it was."""
        held, self._held = "".join(self._held), []
        self._file.write(held.encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


DISTURBANCES = "disturbances.csv"
"""The file in a results folder if its scenario has disturbances."""


def write_resolved(folder: Path, scenario: Scenario, taken: bool = False) -> None:
    """Write the scenario.toml of a results folder, and its states and disturbances; each file is complete at any moment.

    taken: whether all states of a program have been written, so that the run can be repeated from them.
    """
    for name, text in {**input_texts(scenario), "scenario.toml": resolved(scenario, taken)}.items():
        replace_private(folder / name, text)


def input_texts(scenario: Scenario) -> dict[str, str]:
    """The files that a complete scenario needs next to it: name → text."""
    plant, process = scenario.plant, scenario.process
    texts = {}
    if plant is not None and plant.disturbance_values:
        texts[DISTURBANCES] = table_text(plant.disturbances, plant.disturbance_units, plant.disturbance_values)
    if process.source == "file":
        texts[STATES] = table_text(process.states or (), process.units, process.state_values or ())
    return texts


def resolved(scenario: Scenario, taken: bool = False) -> str:
    """The complete scenario as TOML, with the versions that made it: running it again gives the same digests.

    taken: as in `write_resolved`.
    """
    tables = scenario.model_dump(mode="json", exclude_none=True)
    if scenario.plant is not None and tables["plant"].pop("disturbance_values", None):
        tables["plant"]["disturbance_file"] = DISTURBANCES
    if scenario.process.given:
        tables["process"].pop("state_values", None)
        tables["process"] |= {"state_file": STATES, **({"source": "file"} if taken else {})}
    if scenario.secret_file is not None:
        tables["secret_file"] = str(Path(scenario.secret_file).absolute())
    tables["made_with"] = made_with(tables)
    return toml_text(tables)


def made_with(tables: dict[str, Any]) -> dict[str, Any]:
    """The versions of the software, and the SHA-256 of the modules of a scenario, given as its tables."""
    return {
        "python": platform.python_version(),
        **_versions(),
        **sources_of(tables),
    }


@cache
def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("evedrop", "numpy", "cryptography", "eclipse-zenoh")}
