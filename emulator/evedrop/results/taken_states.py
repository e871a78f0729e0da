"""The file of the states that a live run takes from a program, a line for each slot.

Source: docs/programs.md, the recorded run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import final

import numpy as np

from evedrop.model.process import Floats
from evedrop.results.folder import private_opener
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.recordings.disturbance_file import number_lines, table_head

STATES = "states.csv"
"""The file in a results folder if its states were given."""


@final
class TakenStates:
    """Writes the levels of the states, as a scenario's `state_file` has them; lines are held back until `write`."""

    def __init__(self, folder: Path, process: ProcessTable) -> None:
        """Raises OSError if the file cannot be written."""
        self._around = np.array(process.around)
        self._file = open(folder / STATES, "a", encoding="utf-8", opener=private_opener)  # noqa: SIM115 - closed by `close`
        self._held: list[str] = [] if self._file.tell() else [table_head(process.states or (), process.units)]

    def add(self, x: Floats) -> None:
        """Add the states of the next slots, as deviations from the reference, (c, n)."""
        rows: Sequence[Sequence[float]] = (x + self._around).tolist()
        self._held.append(number_lines(rows))

    def write(self) -> None:
        """Write all lines that are held back. Raises OSError if they cannot be written."""
        held, self._held = "".join(self._held), []
        self._file.write(held)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
