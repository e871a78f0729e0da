"""Makes the recording of a wire from its journal.

Source: docs/wire.md, the view.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow.compute as pc
import rerun as rr

from evedrop.errors import UsageError
from evedrop.results.folder import private_file
from evedrop.results.wire_folder import WIRE_FILE
from evedrop.wire.file import load_wire
from evedrop.wire.history import WireHistory
from evedrop.wire.journal_part import records_of
from evedrop.wire.journal_reader import JOURNAL_FOLDER, journal_tables
from evedrop.wire.notices import Notice, introduction, level_of
from evedrop.wire.panels import Pace, WirePanels
from evedrop.wire.plan import WirePlan
from evedrop.wire.step_counts import StepCounter

PICTURE_SIZE = (1200, 720)
"""Width and height of a picture of a wire, in pixels."""
_WRITE_SECONDS = 60.0  # for the disk to take what was recorded


def replay_wire(folder: Path, path: Path) -> Path:
    """Write the recording of the latest start of a wire to a path, from the journal in its folder; returns the path.

    Raises UsageError if the folder cannot be read, if nothing has crossed the wire, or if the path cannot be written.
    """
    plan, history = load_wire(folder / WIRE_FILE), WireHistory.read(folder / JOURNAL_FOLDER)
    ends = [pc.max(table["time"]).as_py() for table in journal_tables(folder, history.start) if table.num_rows]
    if not ends:
        raise UsageError(f"{folder} shows nothing: no message came to the wire since its latest start")
    pace = Pace.of_length(max(0.0, max(ends) - history.began))
    panels, counter = WirePanels(plan, pace), StepCounter(len(plan.links), pace.step, history.began)
    links = {link.name: link.number for link in plan.links}
    file = rr.RecordingStream("evedrop", recording_id=folder.resolve().name)
    try:
        file.save(private_file(path), default_blueprint=panels.layout())
        panels.style(file)
        panels.notes([*_notices(plan, history)], file)
        for table in journal_tables(folder, history.start):
            for steps in counter.add(records_of(table, links)):
                panels.send(steps, file)
        for steps in counter.finish():
            panels.send(steps, file)
        panels.end(file)
        file.flush(timeout_sec=_WRITE_SECONDS)
    except (OSError, RuntimeError) as error:
        path.unlink(missing_ok=True)
        raise UsageError(f"{path} cannot be written ({error}); make room on its disk") from error
    finally:
        file.disconnect()
    return path


def _notices(plan: WirePlan, history: WireHistory) -> Iterator[Notice]:
    """The lines of the events panel that do not come from messages."""
    again = "" if history.start == 1 else f"; start {history.start} in this folder"
    yield Notice(0.0, "INFO", introduction(plan) + again)
    for event in history.noted:
        yield Notice(max(0.0, event.time - history.began), level_of(event.line), event.line)
