"""Live runs in the simulated world."""

from __future__ import annotations

from dataclasses import replace

import pytest

from evedrop.cli.simulated import program
from evedrop.live.recorder.steering import Steering
from evedrop.scenario.loading import Scenario
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.faults import CutConnection, KillProcess, StopProcess

SCENARIO = Scenario(
    title="A receiver that leaves",
    slots=12,
    process={"A": [[1.0]], "Q": [[0.01]], "initial_covariance": [[1.0]]},
    encoding={"scheme": "plain"},
    legitimate={"link": {"quality": 0.9}},
    eavesdroppers={"eve": {"strategy": "naive", "link": {"quality": 0.9}}},
    event=[{"from": 4, "to": 8, "kill": "eve", "state": "last"}],
)


def test_a_run_ends_by_the_name_of_a_receiver_that_never_sends_its_final_belief(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is asked for again, but not for ever."""
    case = SimulatedCase(1, SCENARIO, ())
    assert play_case(case, program).misses == ()
    monkeypatch.setattr(Steering, "left", lambda *_: None)
    run = play_case(case, program).run
    assert run.status == 3
    assert "eve has not sent its final belief" in run.said
    assert run.seconds < 60.0


@pytest.mark.campaign
def test_a_process_that_is_cut_off_at_any_moment_is_named() -> None:
    """Before all are there, too: the recorder, which it does not see, is not said to be missing."""
    for events in range(20, 130, 6):
        played = play_case(SimulatedCase(1, SCENARIO, (CutConnection("legitimate", events),)), program)
        assert played.misses == (), events
        assert "legitimate" in played.run.said.partition("\n")[0]


@pytest.mark.campaign
@pytest.mark.parametrize(
    "fault", [StopProcess("launcher", 0), KillProcess("fork server of the recorder", 0)], ids=lambda fault: fault.target
)
def test_a_run_keeps_its_promises_without_those_that_start_processes(fault: Disturbance) -> None:
    """Whenever they are suspended for good, or killed."""
    for events in range(20, 400, 20):
        assert play_case(SimulatedCase(1, SCENARIO, (replace(fault, after=events),)), program).misses == (), events
