"""The unit in which panels record: values of one entity over some slots, in Rerun's form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from evedrop.model.process import Floats

TIMELINE = "slot_number"
"""Rerun makes the events' first column as wide as this name, and "slot" is too narrow for a number."""
ELAPSED = "elapsed"
"""The time line of a wire, which has no slots: seconds since its start."""


@dataclass(frozen=True)
class Column:
    """Values of one entity over some slots: the arguments of Rerun's `send_columns`."""

    path: str
    slots: NDArray[np.int64]
    values: rr.ComponentColumnList

    def send(self, to: rr.RecordingStream) -> None:
        """Add it to a recording. Raises an error from Rerun if slots and values do not have the same length."""
        slots = rr.TimeColumn(TIMELINE, sequence=self.slots)
        to.send_columns(self.path, indexes=[slots], columns=self.values, strict=True)


def scalars(path: str, k: NDArray[np.int64], values: Floats) -> Column:
    """A number in each slot: slots k (c,), and values (c,)."""
    return Column(path, k, rr.Scalars.columns(scalars=values))
