"""The messages of a wire that tests of its view show, and what a recording of them contains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from evedrop.show.view.column import ELAPSED

RATES = {"scan": 100.0, "command": 20.0, "listener": 100.0}
SECONDS = 12.0
CUT = (6.0, 8.0)


def shown(rrd: Path, entity: str, component: str) -> list[tuple[float, Any]]:
    """The component's values of one entity, with their times in seconds, in order of time."""
    shown_ = []
    for chunk in RrdReader(rrd).stream().filter(content=f"/{entity}", is_static=False):
        columns = chunk.to_record_batch().to_pydict()
        times = [time.total_seconds() for time in columns[ELAPSED]]
        shown_ += list(zip(times, columns[component], strict=True))
    return sorted(shown_, key=lambda pair: pair[0])


def texts(rrd: Path) -> list[tuple[float, str]]:
    """The lines of the events."""
    events: list[tuple[float, str]] = []
    for _, document in shown(rrd, "events", "TextDocument:text"):
        for line in reversed(document[0].splitlines()):
            when, *_, text = line.split("   ")
            event = float(when.removesuffix(" s")), text
            if event not in events:
                events.append(event)
    return events
