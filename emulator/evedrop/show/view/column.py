"""What views share of Rerun: the unit in which panels record, values of one entity over some slots; and their layout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
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


def laid_out(content: rrb.Container, timeline: str) -> rrb.Blueprint:
    """A view that shows its content alone, without the viewer's own panels, and follows the newest moment of a time line."""
    return rrb.Blueprint(
        content,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )
