"""The times of slots, which the axes of the view show where a slot has seconds; and lines as Rerun takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from evedrop.show.view.column import CLOCK, ELAPSED, TIMELINE, SlotTimes, line_strips
from evedrop.show.view.picture import HeadlessViewer
from evedrop.show.view.recording import ViewRecording
from tests.show.view.read_back import events
from tests.show.view.simulated_run import Simulated

NANOSECONDS = 1_000_000_000


@pytest.mark.parametrize(
    ("slots", "seconds", "line", "text"),
    [
        (3000, None, TIMELINE, "#1848"),
        (1500, 0.02, ELAPSED, "36.96 s  #1848"),
        (86_400, 1.0, CLOCK, "00:30:48  #1848"),
        (2880, 60.0, CLOCK, "day 2, 06:48:00  #1848"),
        (3000, 1e-7, TIMELINE, "#1848"),  # Rerun counts nanoseconds, in 63 bits
        (20_000, 1e6, TIMELINE, "#1848"),
    ],
)
def test_a_time_for_every_length_of_a_slot(slots: int, seconds: float | None, line: str, text: str) -> None:
    """The slot without seconds, seconds for a short run, and the time of day for one of hours."""
    times = SlotTimes.of(slots, seconds)
    assert (times.line, times.text(1848)) == (line, text)


@pytest.mark.parametrize(("seconds", "line"), [(0.02, ELAPSED), (60.0, CLOCK), (None, TIMELINE)])
def test_every_row_has_its_slot_and_its_time(
    seconds: float | None, line: str, simulated: Callable[..., Simulated], tmp_path: Path
) -> None:
    """In the whole recording, so that the viewer can show either; events have both, too."""
    run = simulated(80)
    recording = ViewRecording(tmp_path / "r.rrd", replace(run.scene, slot_seconds=seconds))
    for slots in run.chunks(30):
        recording.add(slots)
    assert recording.close()
    lines = {line, TIMELINE}
    for chunk in RrdReader(tmp_path / "r.rrd").stream().filter(is_static=False):
        if "properties" in chunk.entity_path:
            continue
        batch = chunk.to_record_batch()
        assert lines == {TIMELINE, ELAPSED, CLOCK} & {*batch.schema.names}, chunk.entity_path
        if seconds is not None:
            slots_of = batch.column(TIMELINE).to_numpy()
            nanoseconds = batch.column(line).to_numpy().astype(np.int64)
            assert (nanoseconds == np.round(slots_of * seconds * NANOSECONDS)).all()
    times = SlotTimes.of(80, seconds)
    for k, shown in events(tmp_path / "r.rrd").items():
        assert shown[0].startswith(times.text(k))


@pytest.mark.parametrize("count", [0, 1, 7])
def test_lines_are_those_that_rerun_makes(count: int) -> None:
    """With values and types alike, so that a viewer draws the same."""
    points = np.random.default_rng(5).normal(size=(count, 5, 2)).astype(np.float32)
    single = [column.as_arrow_array() for column in rr.LineStrips2D.columns(strips=points)]
    whole = [column.as_arrow_array() for column in rr.LineStrips2D.columns(strips=line_strips(points))]
    assert whole == single
    assert [array.type for array in whole] == [array.type for array in single]


class Client:
    """A viewer's client that has loaded a run of 3000 slots, and keeps the times it is told to show."""

    def __init__(self, seconds: float | None, line: str) -> None:
        ends = {TIMELINE: 2999, **({} if seconds is None else {line: round(2999 * seconds * NANOSECONDS)})}
        self._lines = [SimpleNamespace(name=name, end=end) for name, end in ends.items()]
        self.shown: list[tuple[str, int]] = []

    def get_state(self) -> SimpleNamespace:
        """What is loaded."""
        return SimpleNamespace(loading=[], views=[object()], recordings=[SimpleNamespace(timelines=self._lines)])

    def open(self, urls: object) -> None:
        """Load a recording."""

    def set_time(self, line: str, *, play_state: str, **time: Any) -> None:
        """Show another moment."""
        assert play_state == "paused"
        (value,) = time.values()
        self.shown.append((line, value if isinstance(value, int) else int(value.astype(np.int64))))


@pytest.mark.parametrize(
    ("seconds", "line"), [(0.02, ELAPSED), (60.0, CLOCK), (1 / 3, ELAPSED), (0.0012345678, ELAPSED)]
)
def test_a_picture_of_a_slot_shows_its_time(seconds: float, line: str) -> None:
    """The time at which the slot has begun, and the next one has not; without seconds, the slot."""
    client = Client(seconds, line)
    viewer = HeadlessViewer(cast(Any, client), cast(Any, SimpleNamespace()), Path("r.rrd"))
    for slot in range(0, 3000, 7):
        viewer.show(slot)
    viewer.show(None)
    begins = SlotTimes.of(3000, seconds).columns(np.arange(3001))[1].as_arrow_array().to_numpy().astype(np.int64)
    expected = [*range(0, 3000, 7), 2999]
    for slot, (shown_line, at) in zip(expected, client.shown, strict=True):
        assert shown_line == line
        assert begins[slot] <= at < begins[slot + 1]
    slots_alone = Client(None, line)
    HeadlessViewer(cast(Any, slots_alone), cast(Any, SimpleNamespace()), Path("r.rrd")).show(1848)
    assert slots_alone.shown == [(TIMELINE, 1848)]
