"""A simulated run as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from evedrop.virtual.steps import steps_of
from tests.virtual.simulated_view import write_recording
from tests.virtual.test_diagram import HAPPENED


def test_a_run_is_recorded_step_by_step(tmp_path: Path) -> None:
    """States of processes, messages, faults, and all steps as text, at their virtual time."""
    rrd, steps = tmp_path / "run.rrd", steps_of(HAPPENED)
    write_recording(steps, rrd)
    rows: list[tuple[str, dict[str, Any]]] = []
    for chunk in RrdReader(rrd).stream().filter(is_static=False):
        columns = chunk.to_record_batch().drop_columns(["log_time"]).to_pydict()
        for i in range(len(columns["step"])):
            rows.append((str(chunk.entity_path), {name: values[i] for name, values in columns.items()}))
    texts = [row["TextLog:text"][0] for path, row in sorted(rows, key=lambda one: one[1]["step"]) if path == "/log"]
    assert len(texts) == len(steps)
    assert texts[1] == "launcher → router: starts"
    states = [
        (row["step"], row["StateChange:state"][0]) for path, row in rows if path.startswith("/processes/001_router")
    ]
    assert [state for _, state in sorted(states)] == ["runs", "is suspended", "runs"]
    (fault,) = (row for path, row in rows if path == "/diagram/faults")
    assert fault["LineStrips2D:labels"] == ["stop router for 1 s"]
    assert fault["elapsed"].total_seconds() == 0.43
    inputs = [row for path, row in rows if path == "/diagram/messages" and row["Arrows2D:labels"] == ["input 1"]]
    assert len(inputs[0]["Arrows2D:vectors"]) == 2
