"""What happened in a run as lines of its recording: live, and of a run made in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from evedrop import load_results, montecarlo
from evedrop.cli.main import main
from evedrop.scenario.progress_events import RunEvent
from evedrop.show.view.scene_slots import replay
from tests.show.view.read_back import events, new_events

EVENTS = [{"at": 3, "link": "legitimate", "set": {"quality": 0.2}}, {"from": 5, "to": 9, "cut": "smart"}]
LINES = {3: ["link legitimate: quality = 0.2"], 5: ["cut smart"], 9: ["heal smart"]}


def test_a_run_in_memory_shows_what_its_scenario_had_happen(tmp_path: Path) -> None:
    """A line at its slot for every event and for its end, from the summary."""
    results = montecarlo("eavesdroppers", trials=1, slots=30, out=tmp_path / "run", event=EVENTS)
    assert [(event["slot"], [event["event"]]) for event in results.summary["events"]] == list(LINES.items())
    assert {event["by"] for event in results.summary["events"]} == {"scenario"}
    shown = new_events(replay(tmp_path / "run"))
    assert {slot: [line for line in shown[slot] if line in LINES[slot]] for slot in LINES} == LINES


def test_no_event_is_shown_before_its_slot(tmp_path: Path) -> None:
    """In every slot, the newest event so far is at the top, and none is of a later slot, although the whole run is recorded."""
    montecarlo("eavesdroppers", trials=1, slots=400, out=tmp_path / "run", event=EVENTS)
    documents = events(replay(tmp_path / "run"))
    assert len(documents) > 5
    for slot, lines in documents.items():
        slots = [int(line.split()[0].removeprefix("#")) for line in lines]
        assert slots == sorted(slots, reverse=True)
        assert slots[0] == slot


def test_what_comes_after_the_last_slot_did_not_happen(tmp_path: Path) -> None:
    """An event that lasts to the end of the run ends in none of its slots."""
    results = montecarlo("eavesdroppers", trials=1, slots=9, out=tmp_path / "run", event=EVENTS)
    assert [event["slot"] for event in results.summary["events"]] == [3, 5]


@pytest.mark.long
def test_a_live_run_shows_what_was_done_to_it(evedrop: Any) -> None:
    """The scenario's events and the operator's, at their slots, in the recording that was made while it went on."""
    scenario = evedrop.folder / "shown.toml"
    evedrop("new", str(scenario))
    changes = ("--slots", "60", "--set", 'event=[{ at = 3, cut = "legitimate" }]', "--set", "expect=[]")
    live = evedrop.live(str(scenario), *changes, "--view", "web", "--paused")
    live.held()
    assert main(["step", str(live.folder), "8"]) == 0
    assert main(["link", str(live.folder), "legitimate", "quality=0.5"]) == 0
    assert main(["resume", str(live.folder)]) == 0
    assert live.end().status == 0
    happened = load_results(live.folder).summary["events"]
    shown = new_events(live.folder / "recording.rrd")
    assert [event["event"] for event in happened if event["by"] == "scenario"] == ["cut legitimate"]
    assert [event["slot"] for event in happened if event["event"] == "cut legitimate"] == [3]
    assert any(event["event"].startswith("link") for event in happened)
    for event in happened:
        assert event["slot"] == 0 or RunEvent(**event).line in shown[event["slot"]]
