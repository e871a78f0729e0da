"""A simulated run in Rerun: a lane for each process, the sequence diagram up to the cursor, and a log of all steps.

Rerun is imported here alone, so that playing cases does not wait for it.

Source: docs/maintainers/simulated-world.md, a failing seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.column import ELAPSED
from evedrop.show.view.palette import ALARM, DECODED, DROPPED, GROUND, LABEL, SILENT, STEEL, SYNCHRONISED, Colour
from evedrop.virtual.diagram import columns_of
from evedrop.virtual.steps import Life, Step

_STEP = "step"
_WIDE, _HIGH = 40.0, 10.0
"""The distances of two processes and of two steps in the diagram."""
_VISIBLE = 32
"""Steps that the diagram shows at first."""
_STATES = {Life.BEGINS: "runs", Life.STOPS: "is suspended", Life.GOES_ON: "runs", Life.ENDS: "has ended"}
_COLOURS: dict[str, Colour] = {"runs": SYNCHRONISED, "is suspended": STEEL, "has ended": SILENT}


def write_recording(steps: Sequence[Step], path: Path) -> None:
    """Write the recording of a run, which Rerun shows."""
    names = columns_of(steps)
    with rr.RecordingStream("evedrop simulated run", send_properties=False) as to:
        to.save(path, default_blueprint=_layout(len(steps)))
        for i, name in enumerate(names):
            to.log(
                _lane(names, name),
                rr.StateConfiguration(values=list(_COLOURS), labels=list(_COLOURS), colors=list(_COLOURS.values())),
                static=True,
            )
            line = [(i * _WIDE, 0.0), (i * _WIDE, len(steps) * _HIGH)]
            to.log(f"diagram/lanes/{i}", rr.LineStrips2D([line], colors=[DROPPED]), static=True)
        tops = [(i * _WIDE, y * _HIGH) for y in (-1, len(steps)) for i in range(len(names))]
        to.log("diagram/names", rr.Points2D(tops, labels=names * 2, colors=[LABEL], show_labels=True), static=True)
        for number, step in enumerate(steps):
            to.set_time(ELAPSED, duration=step.at)
            to.set_time(_STEP, sequence=number)
            _log(to, step, number, names)
        to.flush()


def _log(to: rr.RecordingStream, step: Step, number: int, names: Sequence[str]) -> None:
    alarming = step.process is None or step.lost
    colour = ALARM if alarming else DECODED if step.steady else LABEL
    who = " → ".join([step.process or "", ", ".join(step.to)]).strip(" →")
    to.log("log", rr.TextLog(f"{who}: {step.text}" if who else step.text, level="WARN" if alarming else "INFO"))
    if step.life is not None and step.about is not None:
        to.log(_lane(names, step.about), rr.StateChange(state=_STATES[step.life]))
    y = number * _HIGH
    places = {name: i * _WIDE for i, name in enumerate(names)}
    if step.process is None:
        across = [(0.0, y), (_WIDE * len(names), y)]
        to.log("diagram/faults", rr.LineStrips2D([across], colors=[colour], labels=[step.text], show_labels=True))
        return
    start = places[step.process]
    ends = [places[name] for name in [*step.others]]
    if ends:
        vectors, origins = [(end - start, 0.0) for end in ends], [(start, y)] * len(ends)
        to.log(
            "diagram/messages",
            rr.Arrows2D(vectors=vectors, origins=origins, colors=colour, labels=[step.text], show_labels=True),
        )
    else:
        to.log("diagram/moments", rr.Points2D([(start, y)], colors=[colour], labels=[step.text], show_labels=True))


def _lane(names: Sequence[str], name: str) -> str:
    """The path of a process's lane; the viewer sorts them by path."""
    return f"processes/{names.index(name):03d}_{rr.escape_entity_path_part(name)}"


def _layout(steps: int) -> rrb.Blueprint:
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    until_cursor = [rrb.VisibleTimeRange(line, start=start, end=end) for line in (_STEP, ELAPSED)]
    last = (steps + 2) * _HIGH
    bounds = rrb.VisualBounds2D(x_range=(-_WIDE, 8.0 * _WIDE), y_range=(last - (_VISIBLE + 2) * _HIGH, last))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.StateTimelineView(name="Processes", origin="processes"),
                rrb.TextLogView(name="Steps", origin="log"),
            ),
            rrb.Spatial2DView(
                name="Diagram",
                origin="diagram",
                background=list(GROUND),
                visual_bounds=bounds,
                time_ranges=until_cursor,
            ),
        ),
        rrb.TimePanel(timeline=_STEP, play_state="following"),
        collapse_panels=True,
    )
