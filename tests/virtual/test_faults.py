"""What the faults of the simulated world do to a run, and that it keeps its promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from evedrop.cli.simulated import program
from evedrop.live.protocol.telemetry import Report
from evedrop.results.reading import Results
from evedrop.scenario.tables import Scenario
from evedrop.virtual import campaign, faults, judge, notes, outsiders
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import EVERYBODY, Disturbance
from evedrop.virtual.moments import CHANGES, COMMANDS
from evedrop.virtual.processes import LAUNCHER
from evedrop.virtual.reference import RunReference
from evedrop.virtual.run import SimulatedRun
from evedrop.virtual.zenoh.access import Access
from tests.virtual.disturbed_runs import SCENARIO, disturbed

STARTS, RUNS = 26, 90
"""Events after which processes are being started, and after which all are there."""


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        (faults.InterruptProcess(LAUNCHER, RUNS), 130, ""),
        (faults.HangUpProcess(LAUNCHER, RUNS), 130, ""),
        (faults.TerminateProcess(LAUNCHER, RUNS), 130, ""),
        (faults.StopAndKillProcess(LAUNCHER, RUNS, 0.5), -9, ""),
        (faults.StopAndKillProcess("eve", RUNS, 0.5), 3, "eve"),
        (faults.HangProcess("eve", RUNS, 2.0), 0, ""),
        (faults.HangProcess("eve", RUNS), 3, "eve: alive, and silent"),
        (faults.DelayThread("router", RUNS, 0.5), 0, ""),
        (faults.StopProcess("recorder", RUNS, 20.0), 0, ""),
        (faults.CutConnection("eve", 3, 0.5, CHANGES), 0, ""),
        (faults.CutConnection("sensor", 1, 0.5, COMMANDS), 0, ""),
        (faults.FlapConnection("eve", RUNS, 0.5), 0, ""),
        (faults.FlapConnection(EVERYBODY, RUNS, 0.5), 0, ""),
        (faults.CutConnection(EVERYBODY, RUNS, 0.5), 0, ""),
        (faults.ShortenMessage("recorder", RUNS + 5), 3, "broke the protocol"),
        (faults.RenameResults("results", RUNS), 0, ""),
        (faults.RemoveResults("results", RUNS), 3, "was removed while the run went on"),
        (faults.LackThreads("machine", STARTS), 3, "cannot be started (Resource temporarily unavailable)"),
        (faults.LackMemory("eve", RUNS), 3, "there is not enough memory"),
        (faults.LackMemory(LAUNCHER, STARTS), 3, "there is not enough memory"),
        (outsiders.AskStatus("run", RUNS), 0, ""),
        (outsiders.PauseRun("run", RUNS, 2.0), 0, ""),
        (outsiders.LetStrangerIn("run", RUNS), 0, ""),
    ],
    ids=str,
)
def test_a_run_ends_as_it_must(fault: Disturbance, status: int, said: str) -> None:
    """With the right status, the right words, and all results so far."""
    run = disturbed(fault).run
    assert (run.status, said in run.said) == (status, True), run.said


@pytest.mark.parametrize("kind", [faults.CutConnection, faults.FreezeConnection])
def test_a_short_fault_does_not_end_one_that_lasts(kind: Callable[..., Disturbance]) -> None:
    """Who is cut off for good stays so when it is cut off again, for a moment."""
    run = disturbed(kind("eve", RUNS), kind("eve", RUNS + 5, 0.01)).run
    assert (run.status, "eve" in run.said) == (3, True), run.said


@pytest.mark.campaign
def test_a_connection_that_flaps_is_cut_more_than_once() -> None:
    """And made again each time."""
    happened = disturbed(faults.FlapConnection("eve", RUNS, 3.0)).run.happened
    cuts = [
        note
        for note in happened
        if note.what == notes.DISCONNECTS and note.words[0] == "eve" and "is cut" in note.words
    ]
    assert len(cuts) > 1


def test_everybody_is_cut_off() -> None:
    """All but the router."""
    happened = disturbed(faults.CutConnection(EVERYBODY, RUNS, 0.5)).run.happened
    cut = {note.words[0] for note in happened if note.what == notes.DISCONNECTS and "is cut" in note.words}
    assert cut == {"sensor", "legitimate", "eve", "recorder"}


def test_a_machine_that_lacks_threads_for_some_time_has_them_again() -> None:
    """A router that is killed then cannot be started again; one that is killed later can."""
    lack = faults.LackThreads("machine", RUNS, 0.2)
    assert disturbed(lack, faults.KillProcess("router", RUNS + 1)).run.status == 3
    assert disturbed(lack, faults.KillProcess("router", RUNS + 60)).run.status == 0


@pytest.mark.parametrize("after", range(80, 170, 10))
def test_a_router_that_lacks_memory_says_so(after: int) -> None:
    """Whichever of its threads lacks it; with the links' delays, the deliveries have one of their own."""
    tables = SCENARIO.as_tables()
    delayed = {"quality": 0.9, "delay": {"model": "constant", "value": 0.4}}
    scenario = Scenario({**tables, "legitimate": {"link": delayed}, "eavesdroppers": {}})
    case = SimulatedCase(1, scenario, (faults.LackMemory("router", after),))
    played = play_case(case, program)
    assert played.misses == ()
    assert "there is not enough memory" in played.run.said


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("fault", "done"),
    [
        (outsiders.ChangeLink("legitimate", RUNS), ["link legitimate: quality = 0.5"]),
        (outsiders.CutLink("eve", RUNS, 0.5), ["cut eve", "heal eve"]),
        (outsiders.CutLink("eve", RUNS), ["cut eve"]),
        (outsiders.PauseRun("run", RUNS, 2.0), ["pause the run", "step 1 slot", "resume the run"]),
    ],
    ids=str,
)
def test_a_run_that_an_operator_steers_has_the_results_of_its_repetition(
    fault: Disturbance, done: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With rows, and theory, for the changed link from its slot on."""
    read: list[str] = []

    def misses(case: SimulatedCase, run: SimulatedRun, *rest: Any) -> list[str]:
        read.extend(event.event for event in Results.read(run.folder).events if event.by == "operator")
        return judge.misses(case, run, *rest)

    monkeypatch.setattr(campaign, "misses", misses)
    disturbed(fault)
    assert read == done


@pytest.mark.parametrize("ends", [faults.InterruptProcess(LAUNCHER, 400), faults.StopProcess("eve", 400)], ids=str)
def test_a_run_that_was_cut_short_counts_what_its_recorder_has_dropped(
    ends: Disturbance, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the others have dropped, they say at the end of a complete run."""
    read: list[Any] = []

    def misses(case: SimulatedCase, run: SimulatedRun, *rest: Any) -> list[str]:
        read.append(Results.read(run.folder).summary["misdelivered"])
        return judge.misses(case, run, *rest)

    monkeypatch.setattr(campaign, "misses", misses)
    disturbed(faults.ConfuseKeys("recorder", RUNS + 60), ends)
    assert read == [{"recorder": 1}]


def test_a_run_that_was_cut_short_has_no_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even that of a receiver which was ahead of the one that froze: it would be of another run than the rows."""
    read: list[Any] = []

    def misses(case: SimulatedCase, run: SimulatedRun, *rest: Any) -> list[str]:
        read.append(Results.read(run.folder).summary)
        return judge.misses(case, run, *rest)

    monkeypatch.setattr(campaign, "misses", misses)
    assert disturbed(faults.FreezeConnection("eve", RUNS + 100)).run.status == 3
    assert read[0]["slots"] < SCENARIO.slots
    assert {peer["digest"] for peer in read[0]["peers"].values()} == {None}


def test_theory_that_is_not_known_after_a_change_stays_where_it_was_before() -> None:
    """Its rows are written when the link changes."""
    changed, as_it_was = (
        RunReference(SCENARIO, {}, {"slots": {(k, "eve"): {"slot": k, "theory": theory} for k in range(3)}})
        for theory in (None, 1.0)
    )
    rows = changed.after(2, as_it_was).tables["slots"].values()
    assert [row["theory"] for row in rows] == [1.0, 1.0, None]


def test_a_stranger_that_reads_a_message_is_a_miss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the router lets everybody do everything."""
    monkeypatch.setattr(Access, "allows", lambda *_: True)
    played = play_case(SimulatedCase(1, SCENARIO, (outsiders.LetStrangerIn("run", RUNS),)), program)
    assert any("the operator reads" in miss for miss in played.misses), played.misses


def test_a_changed_scenario_that_cannot_be_written_costs_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """The change is not made, and the run ends; its summary is of all rows, and lists no such event."""
    read: list[Any] = []

    def misses(case: SimulatedCase, run: SimulatedRun, *rest: Any) -> list[str]:
        read.append(Results.read(run.folder).summary["events"])
        return judge.misses(case, run, *rest)

    monkeypatch.setattr(campaign, "misses", misses)
    scenario = Scenario({**SCENARIO.as_tables(), "slots": 60, "pace": 0.0})
    struck = (outsiders.ChangeLink("legitimate", RUNS), faults.BreakWrite("disk", RUNS))
    played = play_case(SimulatedCase(1, scenario, struck, ahead=3), program)
    assert played.misses == ()
    assert "scenario.toml" in played.run.said
    assert read == [[]]


def test_a_receiver_that_contradicts_itself_in_one_shard_is_verified_in_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run ends with its name, and the summary of all shards does not call its metrics verified."""
    read: list[Any] = []
    honest = Report.pack

    def lie(report: Report) -> bytes:
        return honest(replace(report, slots=replace(report.slots, x_hat=report.slots.x_hat * 0.0 + 7.0)))

    def misses(case: SimulatedCase, run: SimulatedRun, *_: Any) -> list[str]:
        read.append(Results.read(run.folder).summary)
        return []

    monkeypatch.setattr(Report, "pack", lie)
    monkeypatch.setattr(campaign, "misses", misses)
    scenario = Scenario({**SCENARIO.as_tables(), "trials": 2, "shards": 2})
    run = play_case(SimulatedCase(1, scenario, ()), program).run
    (accused,) = {name for name in scenario.receivers if f"{name} contradicts itself" in read[0]["ended"]}
    assert (run.status, f"{accused} contradicts itself" in run.said) == (3, True), run.said
    checked = {name: entry["verified"] for name, entry in read[0]["verification"].items()}
    assert [name for name, verified in checked.items() if not verified] == [accused]
    assert read[0]["peers"][accused]["digest"] is None
