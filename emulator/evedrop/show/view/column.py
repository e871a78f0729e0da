"""What views share of Rerun: the unit in which panels record, values of one entity over some slots; and their layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import pyarrow as pa
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


def joined(columns: Sequence[Column]) -> list[Column]:
    """The same values with a column for each entity and set of components; columns: those of an entity in order of slot."""
    groups: dict[tuple[str, tuple[rr.ComponentDescriptor, ...]], list[Column]] = {}
    for column in columns:
        components = tuple(component.component_descriptor() for component in column.values)
        groups.setdefault((column.path, components), []).append(column)
    return [
        Column(
            path,
            np.concatenate([column.slots for column in group]),
            rr.ComponentColumnList(
                _concatenated(component, [parts[i] for parts in values]) for i, component in enumerate(components)
            ),
        )
        for (path, components), group in groups.items()
        for values in [[[part.as_arrow_array() for part in column.values] for column in group]]
    ]


def _concatenated(component: rr.ComponentDescriptor, parts: Sequence[pa.ListArray]) -> rr.ComponentColumn:
    whole = pa.concat_arrays(parts)
    return rr.ComponentColumn(component, _Values(component, whole.values), offsets=whole.offsets.to_numpy())


@final
@dataclass(frozen=True)
class _Values:
    """Values of a component as Rerun takes them."""

    component: rr.ComponentDescriptor
    values: pa.Array

    def component_type(self) -> str:
        """The name of their type."""
        return self.component.component_type or ""

    def as_arrow_array(self) -> pa.Array:
        """The values of all slots."""
        return self.values


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
