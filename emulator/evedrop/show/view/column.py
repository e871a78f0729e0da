"""What views share of Rerun: the unit in which panels record, values of one entity over some slots; and their layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from evedrop.model.process import Floats

TIMELINE = "slot_number"
ELAPSED = "elapsed"
"""The time line of a wire, which has no slots, and of a run whose slots have seconds: time since its start."""
CLOCK = "clock"
"""That of a run of hours or days: the time of day, from midnight on. Rerun calls the first day 1970-01-01."""
_HOUR = 3600.0
_SHORTEST, _LONGEST = 1e-6, 9e9  # seconds of a slot, and of a run


@final
@dataclass(frozen=True)
class SlotTimes:
    """The time lines of a run: the slots' numbers; and where slots have seconds, the times at which they begin."""

    slots: int
    seconds: float | None
    """Of a slot."""

    @classmethod
    def of(cls, slots: int, seconds: float | None) -> SlotTimes:
        """For slots of some seconds; without times if Rerun's nanoseconds are too coarse for them or end too early."""
        countable = seconds is not None and seconds >= _SHORTEST and slots * seconds < _LONGEST
        return cls(slots, seconds if countable else None)

    @property
    def line(self) -> str:
        """The time line that the axes show."""
        if self.seconds is None:
            return TIMELINE
        return ELAPSED if self.seconds * self.slots < _HOUR else CLOCK

    def columns(self, slots: NDArray[np.int64]) -> list[rr.TimeColumn]:
        """The times of slots on all lines, (c,)."""
        numbers = rr.TimeColumn(TIMELINE, sequence=slots)
        if self.seconds is None:
            return [numbers]
        nanoseconds = np.round(slots * (self.seconds * 1e9)).astype(np.int64)
        if self.line == CLOCK:
            return [numbers, rr.TimeColumn(CLOCK, timestamp=nanoseconds.astype("datetime64[ns]"))]
        return [numbers, rr.TimeColumn(ELAPSED, duration=nanoseconds.astype("timedelta64[ns]"))]

    def at(self, slot: int) -> rrb.TimeRangeBoundary:
        """The time of a slot, as an end of an axis."""
        if self.seconds is None:
            return rrb.TimeRangeBoundary.absolute(seq=slot)
        return rrb.TimeRangeBoundary.absolute(seconds=slot * self.seconds)

    def after_cursor(self, slots: int) -> rrb.TimeRangeBoundary:
        """The time some slots after that shown, as an end of an axis; a negative number: before it."""
        if self.seconds is None:
            return rrb.TimeRangeBoundary.cursor_relative(seq=slots)
        return rrb.TimeRangeBoundary.cursor_relative(seconds=slots * self.seconds)

    def text(self, slot: int) -> str:
        """Such as "#1848"; "14:30:05  #52205" or "12.30 s  #615" where slots have seconds."""
        if self.seconds is None:
            return f"#{slot}"
        time = slot * self.seconds
        if self.line == ELAPSED:
            return f"{time:.2f} s  #{slot}"
        day, rest = divmod(int(time), 86_400)
        clock = f"{rest // 3600:02}:{rest % 3600 // 60:02}:{rest % 60:02}"
        return f"{f'day {day + 1}, ' if day else ''}{clock}  #{slot}"


@dataclass(frozen=True)
class Column:
    """Values of one entity over some slots: the arguments of Rerun's `send_columns`."""

    path: str
    slots: NDArray[np.int64]
    values: rr.ComponentColumnList

    def send(self, to: rr.RecordingStream, times: SlotTimes) -> None:
        """Add it to a recording. Raises an error from Rerun if slots and values do not have the same length."""
        to.send_columns(self.path, indexes=times.columns(self.slots), columns=self.values, strict=True)


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


def line_strips(points: NDArray[np.float32]) -> Any:
    """Lines with equally many points, (f, p, 2), as `rr.LineStrips2D.columns` takes them; Rerun would convert them one by one."""
    count, length, _ = points.shape
    inner = rr.encodings.Vec2DBatch(points.reshape(-1, 2)).as_arrow_array()
    kind = rr.components.LineStrip2DBatch([]).as_arrow_array().type
    return pa.ListArray.from_arrays(length * np.arange(count + 1, dtype=np.int32), inner, type=kind)


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
