"""The judge sees a run that tells its operators what it does not do, and a scenario.toml that is not that of the run."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import pytest

from evedrop.cli.simulated import program
from evedrop.live.network.operator import Order
from evedrop.live.recorder.steering import Steering
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.tables import Scenario
from evedrop.virtual import outsiders
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.notes import PutMessage
from evedrop.virtual.steered import Typed, broken_holds, wrong_scenario
from tests.virtual.disturbed_runs import SCENARIO

PAUSED = Typed("pause", 1.0, 1.1, 0, "held before slot 5\n")
STEPPED = Typed("step 2", 2.0, 2.1, 0, "2 slots passed; held before slot 7\n")
EVENTS = ({"at": 6, "link": "eve", "set": {"quality": 0.3}}, {"at": 8, "cut": "eve"}, {"at": 9, "heal": "eve"})
TYPED = ("link eve quality=0.3", "link eve cut", "link eve heal")


@pytest.mark.parametrize(
    ("typed", "sent", "missed"),
    [
        ([PAUSED], "4", None),
        ([PAUSED], "5", "slot 5 is sent, and pause said: held before slot 5"),
        ([Typed("pause", 1.0, 1.1, 2, "no: held before slot 5")], "5", None),
        ([PAUSED, Typed("status", 1.0, 1.2, 0, "held before slot 5")], "5", None),
        ([PAUSED, Typed("resume", 1.15, 1.3, 0, "goes on")], "5", None),
        ([PAUSED, STEPPED], "4", None),
        (
            [PAUSED, Typed("step 3", 2.0, 2.1, 0, "held before slot 7")],
            "4",
            "step 3 from slot 5 said: held before slot 7",
        ),
    ],
)
def test_a_run_that_is_held_sends_no_more(typed: list[Typed], sent: str, missed: str | None) -> None:
    """Until another command, and a step is as long as it was to be."""
    put = [PutMessage(1.2, "uplink", sent), PutMessage(1.2, "control/sensor", "go 9")]
    assert [*broken_holds(typed, put)] == ([missed] if missed else [])


@pytest.mark.parametrize(
    ("written", "typed", "missed"),
    [
        ({}, {}, None),
        ({"event": EVENTS}, dict.fromkeys(TYPED, 0), None),
        ({"event": EVENTS}, {**dict.fromkeys(TYPED, 0), TYPED[0]: None}, None),
        ({"seed": 8}, {}, "scenario.toml has seed = 8, and the run 7"),
        ({}, {TYPED[1]: 0, "pause": 0}, "scenario.toml lacks what operators were told to be done: link eve cut"),
        ({"event": EVENTS[:1]}, {TYPED[1]: 2}, "scenario.toml has what nobody typed: link eve quality=0.3"),
    ],
)
def test_a_scenario_has_what_operators_changed(
    written: dict[str, object], typed: dict[str, int | None], missed: str | None, tmp_path: Path
) -> None:
    """Of the changes of which they got no answer, it may have any; and nothing else is changed."""
    scenario = Scenario({**SCENARIO.as_tables(), "seed": 7})
    write_resolved(tmp_path, Scenario({**scenario.as_tables(), **written}))
    commands = [Typed(words, 1.0, 1.1, status) for words, status in typed.items()]
    assert [*wrong_scenario(tmp_path, scenario, commands)] == ([missed] if missed else [])


def test_a_scenario_lacks_no_event(tmp_path: Path) -> None:
    """Nor can it be another file."""
    write_resolved(tmp_path, SCENARIO)
    eventful = Scenario({**SCENARIO.as_tables(), "event": [EVENTS[0]]})
    assert [*wrong_scenario(tmp_path, eventful, ())] == ["scenario.toml lacks events of the scenario: []"]
    (tmp_path / "scenario.toml").write_text("slots =")
    (miss,) = wrong_scenario(tmp_path, SCENARIO, ())
    assert "scenario.toml cannot be read" in miss


def _only_answer(_: Steering, k: int, order: Order, __: object) -> None:
    order.done(k, f"from slot {k} on: done")


@pytest.mark.parametrize(
    ("command", "miss"),
    [
        (outsiders.ChangeLink("legitimate", 130), "what operators were told to be done: link legitimate quality"),
        (outsiders.CutLink("legitimate", 130, None), "what operators were told to be done: link legitimate cut"),
    ],
    ids=str,
)
def test_a_command_that_is_answered_and_not_obeyed_is_a_miss(command: Disturbance, miss: str) -> None:
    """The run says that the change is made, and does not make it."""
    with patch.object(Steering, "_change", _only_answer):
        misses = play_case(SimulatedCase(1, SCENARIO, (command,)), program).misses
    assert any(miss in broken for broken in misses), misses
