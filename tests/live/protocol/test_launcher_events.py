"""Events of a run: each kind is read as it was written, and a malformed line is refused."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from evedrop.live.protocol.launcher_events import Alive, ProcessRequest, SaveStarted, SlotsDone, read_event
from evedrop.names import ProcessAction
from evedrop.scenario.progress_events import (
    ConnectionOutage,
    FolderMoved,
    Held,
    ProgressEvent,
    RunEnded,
    RunEvent,
    RunProgress,
    Started,
    ViewOpened,
    silent,
)

KINDS: list[ProgressEvent] = [
    Alive(),
    Started(),
    Held(7),
    ProcessRequest(ProcessAction.END, "eve", 4, 2),
    ConnectionOutage("eve", 3, 9, 0.5),
    ConnectionOutage("eve", 3, None, 0.5, 1),
    RunProgress(40, 12.5, "slots/s", {"eve": math.inf}),
    RunProgress(40, 12.5, "trial-slots/s", {}, 80),
    SlotsDone(),
    SaveStarted(),
    RunEnded(3, "a crash", ["eve"], ["router"], "no screen"),
    RunEnded(0, "complete", [], []),
    ViewOpened("http://127.0.0.1:1/", None),
    ViewOpened(None, "no screen"),
]


@pytest.mark.parametrize("event", KINDS, ids=lambda event: type(event).__name__)
def test_news_is_read_as_it_was_written(event: ProgressEvent) -> None:
    """One line of JSON, which names its kind."""
    assert event.line.endswith(b"\n")
    assert event.line.count(b"\n") == 1
    assert json.loads(event.line)["event"] == event.__struct_config__.tag
    assert read_event(event.line) == event


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"", "Expecting value"),
        (b"[" * 100_000, "it is nested too deeply"),
        (b"[]", "Expected `object`, got `array`"),
        (b"{}", "Object missing required field `event`"),
        (b'{"event": 3}', "Expected `str`, got `int` - at `$.event`"),
        (b'{"event": "dance"}', "Invalid value 'dance' - at `$.event`"),
        (b'{"event": "held"}', "Object missing required field `before`"),
        (b'{"event": "held", "before": -1}', "Expected `int` >= 0 - at `$.before`"),
        (b'{"event": "alive", "k": 1}', "Object contains unknown field `k`"),
        (b'{"event": "act", "do": "dance", "process": "eve", "first": 0, "number": 1}', "Invalid enum value 'dance' - at `$.do`"),
        (b'{"event": "progress", "done": 1, "rate": "x", "rate_unit": "s", "squared_errors": {}}', "got `str` - at `$.rate`"),
        (
            b'{"event": "progress", "done": 1, "rate": 1, "rate_unit": "s", "squared_errors": {"eve": null}}',
            "Expected `float`, got `null` - at `$.squared_errors[...]`",
        ),
        (b'{"event": "ended", "status": 256, "how": "x"}', "Expected `int` <= 255 - at `$.status`"),
    ],
)  # fmt: skip
def test_a_malformed_line_is_refused(line: bytes, message: str) -> None:
    """With a ValueError that says what is wrong with it."""
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are compared below
        read_event(line)
    assert message in str(refused.value)


@pytest.mark.parametrize(("status", "well"), [(0, True), (1, True), (2, False), (3, False), (130, False)])
def test_a_run_ended_well_if_it_came_to_its_end(status: int, well: bool) -> None:
    """Even if an expectation failed."""
    assert RunEnded(status, "complete").well is well


@pytest.mark.parametrize(("by", "line"), [("scenario", "cut eve"), ("operator", "cut eve (by the operator)")])
def test_the_view_shows_who_caused_an_event(by: str, line: str) -> None:
    """Unless it was the scenario."""
    assert RunEvent(3, "cut eve", by).line == line


def test_only_the_launcher_tells_that_the_folder_moved(capsys: pytest.CaptureFixture[str]) -> None:
    """The launcher refuses a recorder that writes it; a caller that ignores events prints nothing."""
    moved: Any = FolderMoved("there")
    with pytest.raises(ValueError, match="Invalid value 'moved'"):
        read_event(moved.line)
    silent(moved)
    assert capsys.readouterr() == ("", "")
