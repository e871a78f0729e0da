"""The judge of simulated runs reports a run that ends late, or that goes on although it was told to end."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.progress_events import RunProgress
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import verification_of
from evedrop.virtual import campaign
from evedrop.virtual.broken_messages import BreakMessage
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import EVERYBODY, Disturbance
from evedrop.virtual.faults import (
    BreakWrite,
    ConfuseKeys,
    CutConnection,
    CutPower,
    FillDisk,
    FreezeConnection,
    HangProcess,
    InterruptProcess,
    KillProcess,
    RemoveResults,
    ShortenMessage,
    StopProcess,
)
from evedrop.virtual.judge import _confused, _falsified, _of_folder, _of_metrics, misses
from evedrop.virtual.metrics import unlike_prefix, wrong_course
from evedrop.virtual.notes import PutMessage
from evedrop.virtual.outsiders import LetStrangerIn
from evedrop.virtual.programs import DrawnProgram
from evedrop.virtual.reference import RunReference
from evedrop.virtual.results import wrong_outages
from evedrop.virtual.run import SimulatedRun
from tests.virtual.simulated import play, read_case

SCENARIO = Scenario(
    {
        "title": "A case",
        "slots": 10,
        "pace": 0.1,
        "longest_outage": 3.0,
        "process": {"A": [[1.0]], "Q": [[1.0]], "initial_covariance": [[1.0]]},
        "encoding": {"scheme": "plain"},
        "legitimate": {"link": {"quality": 1.0}},
    }
)
REFERENCE = RunReference(SCENARIO, {"slots": 10}, {})
KILLED = KillProcess("legitimate", 50)
TOLD = InterruptProcess("launcher", 60)


def judged(
    folder: Path,
    struck: Mapping[Disturbance, float],
    ahead: int = 8,
    scenario: Scenario = SCENARIO,
    program: DrawnProgram | None = None,
    **run: object,
) -> list[str]:
    """The misses of a run without results; ahead: how far the sensor may be ahead."""
    (folder / "temporary").mkdir(parents=True, exist_ok=True)
    faults = tuple(struck)
    ended = SimulatedRun(folder / "results", **run)  # type: ignore[arg-type]
    return misses(
        SimulatedCase(1, scenario, faults, ahead, program=program), ended, struck, REFERENCE, {"": folder / "temporary"}
    )


def with_outage(first: int, end: int) -> Scenario:
    """The scenario, whose legitimate estimator is away in these slots."""
    return Scenario({**SCENARIO.as_tables(), "event": [{"from": first, "to": end, "pause": "legitimate"}]})


@pytest.mark.parametrize(("seconds", "late"), [(56.0, False), (58.0, True)])
def test_a_run_that_ends_late_is_a_miss(seconds: float, late: bool, tmp_path: Path) -> None:
    """1 s of slots, 5 of any run, 15 of a fault, twice the longest outage, and 30 for processes that do not appear."""
    hangs = HangProcess("legitimate", 50)
    broken = judged(tmp_path, {hangs: 0.5}, status=3, said="evedrop: legitimate: alive, and silent", seconds=seconds)
    assert broken == (["the run took 58.0 s, and not 57.0 s at most"] if late else [])


@pytest.mark.parametrize(("seconds", "told", "late"), [(3.4, "go 5", False), (3.6, "go 5", True), (3.6, "end", False)])
def test_a_process_that_ends_ends_its_run_at_once(seconds: float, told: str, late: bool, tmp_path: Path) -> None:
    """Its launcher waits for it, and asks nobody; but the report of a process on a run that is over may be waited for."""
    put = [PutMessage(0.6, "control/legitimate", told)]
    said = "evedrop: legitimate was ended by signal 9"
    broken = judged(tmp_path, {KILLED: 0.5}, status=3, said=said, seconds=seconds, put=put)
    assert any("the run goes on for" in miss for miss in broken) is late


@pytest.mark.parametrize(("target", "missed"), [("launcher", False), ("recorder", False), ("legitimate", True)])
def test_only_who_is_told_that_the_run_ends_is_interrupted(target: str, missed: bool, tmp_path: Path) -> None:
    """A signal to any other process is a failure of that process."""
    broken = judged(tmp_path, {InterruptProcess(target, 50): 0.5}, status=130, seconds=1.0)
    assert any("by which none of this ends a run" in miss for miss in broken) is missed


@pytest.mark.parametrize(("sent", "missed"), [(1.4, False), (1.6, True)])
def test_a_run_does_not_end_well_without_its_folder(sent: float, missed: bool, tmp_path: Path) -> None:
    """If it goes on after that was removed."""
    removed = RemoveResults("results", 50)
    broken = judged(tmp_path, {removed: 0.5}, status=0, seconds=2.0, put=[PutMessage(sent, "uplink", "3")])
    assert ("the run ends with status 0, although its results were removed at 0.50 s" in broken) is missed


@pytest.mark.parametrize(("seconds", "kept"), [(0.5, False), (2.0, True)])
def test_a_process_that_its_launcher_ends_is_a_miss(seconds: float, kept: bool, tmp_path: Path) -> None:
    """It waited in vain for the end of a run that completes; a router that was suspended for longer is ended."""
    struck: dict[Disturbance, float] = {CutConnection("sensor", 50, seconds): 0.5}
    broken = judged(tmp_path, struck, status=0, seconds=2.0, ends={"sensor": (2.0, 130), "router": (2.0, 0)})
    assert ("the run completes, and sensor ends with status 130" in broken) is not kept


def test_who_misses_one_message_need_not_end(tmp_path: Path) -> None:
    """It still has its connection."""
    struck: dict[Disturbance, float] = {ConfuseKeys(EVERYBODY, 50): 0.5}
    assert not any(
        "does not end" in miss for miss in judged(tmp_path, struck, status=3, ends={"legitimate": (30.0, 130)})
    )


@pytest.mark.parametrize("fault", [BreakWrite("disk", 50), FillDisk("disk", 50)])
def test_what_cannot_be_removed_stays(fault: Disturbance, tmp_path: Path) -> None:
    """After an input/output error; a full disk lets everything be removed."""
    (tmp_path / "temporary" / "evedrop-1").mkdir(parents=True)
    broken = judged(tmp_path, {fault: 0.5}, status=3)
    assert ("evedrop-1 is left" in broken) is isinstance(fault, FillDisk)


@pytest.mark.parametrize(("ended", "began", "late"), [(8.9, 0.4, False), (9.1, 0.4, True), (9.1, 0.6, False)])
def test_a_process_that_goes_on_without_a_connection_is_a_miss(
    ended: float, began: float, late: bool, tmp_path: Path
) -> None:
    """It ends after the longest outage, 4 s until a connection counts as lost, and 1.5 s; later if the run had not begun."""
    struck: dict[Disturbance, float] = {FreezeConnection(EVERYBODY, 50): 0.5}
    said, put = "evedrop: router stopped responding", [PutMessage(began, "uplink", "0")]
    broken = judged(tmp_path, struck, status=3, said=said, seconds=12.0, ends={"legitimate": (ended, 130)}, put=put)
    assert broken == ([f"legitimate does not end, though it has had no connection for {ended - 0.5} s"] if late else [])


@pytest.mark.parametrize("away", [True, False])
def test_who_is_away_at_times_may_wait_for_its_launcher(away: bool, tmp_path: Path) -> None:
    """While it is away, it watches no connection."""
    struck: dict[Disturbance, float] = {FreezeConnection(EVERYBODY, 50): 0.5}
    ends, put = {"legitimate": (9.1, 130)}, [PutMessage(0.4, "uplink", "0")]
    scenario = with_outage(5, 9) if away else SCENARIO
    broken = judged(tmp_path, struck, scenario=scenario, status=3, ends=ends, put=put)
    assert any("does not end" in miss for miss in broken) is not away


@pytest.mark.parametrize(
    ("fault", "most"), [(CutConnection("sensor", 50, 0.5), 12.5), (StopProcess("sensor", 50, 0.5), 6.5)], ids=str
)
def test_a_fault_that_loses_no_message_costs_what_it_lasts(fault: Disturbance, most: float, tmp_path: Path) -> None:
    """1 s of slots, 5 of any run, 6 if messages must be sent again, and the half."""
    assert judged(tmp_path / "in time", {fault: 0.5}, status=0, seconds=most) == ["there are no results"]
    late = judged(tmp_path / "late", {fault: 0.5}, status=0, seconds=most + 1.0)
    assert late == [f"the run took {most + 1.0} s, and not {most} s at most", "there are no results"]


def test_a_full_disk_is_no_process_that_is_silent(tmp_path: Path) -> None:
    """Who is cut off just then is not blamed."""
    struck: dict[Disturbance, float] = {FillDisk("disk", 50): 0.5, CutConnection("sensor", 50, 0.5): 0.4}
    said = "evedrop: sensor stopped responding: hung, suspended or cut off\nthe disk"
    assert f"the disk fails, and a process is blamed: {said.splitlines()[0]}" in judged(
        tmp_path, struck, status=3, said=said, seconds=2.0
    )


def test_a_fork_server_that_is_suspended_may_cost_two_minutes(tmp_path: Path) -> None:
    """Its launcher waits for it so long."""
    said = "evedrop: recorder cannot be started (its fork server did not respond within 120 s)"
    stopped = StopProcess("fork server", 30)
    assert judged(tmp_path, {stopped: 0.1}, status=3, said=said, seconds=120.2) == []


@pytest.mark.parametrize(("moment", "ignored"), [(1.4, False), (1.6, True)])
def test_a_launcher_that_goes_on_after_a_signal_is_a_miss(moment: float, ignored: bool, tmp_path: Path) -> None:
    """A second after it was told to end, no more slots are done."""
    told = [(moment, RunProgress(5, 1.0, "slots/s", {}))]
    broken = judged(tmp_path, {TOLD: 0.5}, status=0, told=told)
    assert "there are no results" in broken
    assert any("went on to its end" in miss for miss in broken) == ignored


@pytest.mark.parametrize(("sent", "wrong"), [("2-7", False), ("2-8", True)])
def test_a_sensor_that_leaves_its_window_is_a_miss(sent: str, wrong: bool, tmp_path: Path) -> None:
    """All processes have done slots 0 to 3, and the window has four slots."""
    done = [PutMessage(0.1, f"progress/{name}", "4") for name in ("legitimate", "recorder")]
    broken = judged(tmp_path, {KILLED: 0.5}, 4, status=3, put=[*done, PutMessage(0.2, "uplink", sent)])
    assert ("slot 8 is sent while slot 4 is not done, in a window of 4" in broken) == wrong


def test_a_command_that_is_sent_again_in_a_quiet_run_is_a_miss(tmp_path: Path) -> None:
    """Nothing was lost that could be sent again."""
    twice = [PutMessage(0.1, "control/sensor", "start")] * 2
    assert "'start' is sent to sensor, 2 times, although nothing happens to the run" in judged(tmp_path, {}, put=twice)
    assert not any("is sent" in miss for miss in judged(tmp_path / "again", {KILLED: 0.5}, put=twice))


@pytest.mark.parametrize(("target", "most"), [("recorder", 21.0), ("everybody", 36.0)])
def test_a_fault_that_everybody_has_may_cost_two(target: str, most: float, tmp_path: Path) -> None:
    """A second of slots, five of any run, and fifteen for each."""
    broken = judged(tmp_path, {ConfuseKeys(target, 60): 0.5}, seconds=most + 0.1)
    assert f"the run took {most + 0.1:.1f} s, and not {most:.1f} s at most" in broken


def test_a_quiet_run_ends_soon(tmp_path: Path) -> None:
    """A second and a half after its slots."""
    assert "the run took 2.6 s, and not 2.5 s at most" in judged(tmp_path, {}, seconds=2.6)


def test_what_one_lost_connection_costs_is_sent_again_once(tmp_path: Path) -> None:
    """A second round means that the first one was in vain."""
    rounds = [PutMessage(at, "control/router", "again 2") for at in (0.5, 1.0)]
    cut = CutConnection("legitimate", 60, 0.01)
    miss = f"messages are asked for 2 times after {cut}"
    assert miss in judged(tmp_path, {cut: 0.4}, put=rounds)
    assert miss not in judged(tmp_path / "once", {cut: 0.4}, put=rounds[:1])
    both = judged(tmp_path / "both", {cut: 0.4, StopProcess("sensor", 60, 1.0): 0.4}, put=rounds)
    assert not any("are asked for" in miss for miss in both)
    away = judged(tmp_path / "away", {cut: 0.4}, scenario=with_outage(5, 8), put=rounds)
    assert not any("are asked for" in miss for miss in away), "a receiver that comes back has a round of its own"


@pytest.mark.parametrize(("sent", "missed"), [("4-5", False), ("5", False), ("hold 5", False), ("6-7", True)])
def test_the_sensor_sends_again_what_it_announces(sent: str, missed: bool, tmp_path: Path) -> None:
    """A router waits for the slot that is announced."""
    put = [PutMessage(0.5, "uplink", said) for said in ("again 5", sent, "8")]
    miss = "slot 5 is announced to be sent again, and slot 6 is sent"
    assert (miss in judged(tmp_path, {KILLED: 0.4}, put=put)) is missed


@pytest.mark.parametrize(("ended", "missed"), [(0.4, False), (0.6, True)])
def test_a_program_that_is_suspended_once_its_session_has_ended_stays(
    ended: float, missed: bool, tmp_path: Path
) -> None:
    """Nobody lets it go on; before, the server does."""
    struck: dict[Disturbance, float] = {StopProcess("evedrop host of host alpha", 60): 0.5}
    left = [f"{name} of host alpha" for name in ("evedrop host", "fork server")]
    broken = judged(tmp_path, struck, status=3, left=left, ends={"sshd of host alpha": (ended, -9)})
    assert ({f"{name} is left" for name in left} <= {*broken}) is missed


@pytest.mark.parametrize(("error", "wrong"), [(1e-16, False), (1e-6, True)])
def test_the_standard_error_of_equal_trials_is_what_rounding_leaves(error: float, wrong: bool) -> None:
    """Shards add up other sums than the run in memory."""
    row = {"slot": 0, "peer": "legitimate", "mean_squared_error": 1.0, "standard_error": 1e-8}
    reference = RunReference(SCENARIO, {}, {"slots": {(0, "legitimate"): row}})
    table = pa.Table.from_pylist([{**row, "standard_error": error}])
    assert [*reference.wrong_rows("slots", table)] == (
        [f"slots (0, 'legitimate'): standard_error is {error}, not 1e-08"] if wrong else []
    )


def test_a_run_that_is_held_gives_up_in_time(tmp_path: Path) -> None:
    """After thirty seconds; one that was told to go on is not held."""
    put = [PutMessage(0.5, "uplink", "hold 5")]
    hangs: dict[Disturbance, float] = {HangProcess("legitimate", 60): 0.5}
    miss = "the run is held for 35.5 s, and goes on to wait"
    assert miss in judged(tmp_path, hangs, put=put, ended=36.0)
    assert miss not in judged(tmp_path / "go", hangs, put=[*put, PutMessage(0.6, "control/sensor", "go 5")], ended=36.0)


def test_who_reports_nothing_because_another_process_hangs_is_not_to_blame(tmp_path: Path) -> None:
    """While the run is held."""
    failure = "evedrop: the run failed: 30 s after the run was held, router and legitimate did not report all slots"
    broken = judged(tmp_path, {HangProcess("router", 60): 0.5}, status=3, said=failure)
    assert f"legitimate is blamed for hang router for good after 60 events: {failure}" in broken


def test_who_gets_a_broken_message_is_not_to_blame(tmp_path: Path) -> None:
    """Whoever sent it is."""
    said = "evedrop: legitimate broke the protocol: refuses = 'input'"
    broken = judged(tmp_path, {ShortenMessage("legitimate", 60): 0.5}, status=3, said=said)
    assert f"legitimate is blamed for a message that it got: {said}" in broken


@pytest.mark.parametrize(("value", "wrong"), [(None, False), (1.0, False), (7.0, True)])
def test_a_live_run_has_no_quantiles_or_those_in_memory(value: float | None, wrong: bool) -> None:
    """Not any number."""
    row = {"slot": 0, "peer": "legitimate", "quantile": 1.0}
    reference = RunReference(SCENARIO, {}, {"slots": {(0, "legitimate"): row}})
    table = pa.Table.from_pylist([{**row, "quantile": value}])
    assert [*reference.wrong_rows("slots", table)] == (
        ["slots (0, 'legitimate'): quantile is 7.0, not 1.0"] if wrong else []
    )


@pytest.mark.parametrize(
    ("also", "said", "rows"),
    [
        ((), "", True),
        ((), "legitimate broke the protocol", False),
        ((ShortenMessage("sensor", 60),), "sensor broke the protocol", True),
    ],
)
def test_a_number_that_nobody_could_read_is_in_no_row(also: tuple[Disturbance, ...], said: str, rows: bool) -> None:
    """But who could not read another message may have read a wrong number before."""
    run = SimulatedRun(Path(), said=said)
    assert _falsified(run, (BreakMessage("recorder", 50), *also)) is rows


@pytest.mark.parametrize(
    ("faults", "count"),
    [
        ((), 0),
        ((KILLED, ConfuseKeys("sensor", 50)), 1),
        ((ConfuseKeys(EVERYBODY, 50),), 4),
        ((LetStrangerIn("run", 50), ConfuseKeys("sensor", 50)), math.inf),
    ],
)
def test_what_others_have_written_may_have_any_key(faults: tuple[Disturbance, ...], count: float) -> None:
    """And of the run's own messages, those that were confused."""
    assert _confused(SimulatedCase(1, SCENARIO, faults), faults) == count


@pytest.mark.parametrize(("all_recorded", "missed"), [(True, True), (False, False)])
def test_the_standard_error_of_trials_that_are_not_recorded_may_be_unknown(all_recorded: bool, missed: bool) -> None:
    """While their block is not complete."""
    in_memory, live = (
        {"slots": 9, "events": [], "peers": {"legitimate": {"standard_errors": {"mean_trace_covariance": error}}}}
        for error in (0.1, None)
    )
    broken = [*unlike_prefix({**live, "controller": {}}, in_memory, all_recorded=all_recorded)]
    assert any("standard_errors.mean_trace_covariance is None" in miss for miss in broken) is missed
    assert "the summary has controller, and in memory it has not" in broken


@pytest.mark.parametrize(("decisions", "missed"), [(0, False), (5, False), (6, True)])
def test_a_controller_may_end_before_it_has_told_of_its_last_decisions(decisions: int, missed: bool) -> None:
    """But it has decided no more often than in memory."""
    live, in_memory = (
        {"slots": 9, "events": [], "controller": {"period": 2, "decisions": some}} for some in (decisions, 5)
    )
    broken = [*unlike_prefix(live, in_memory, all_recorded=True)]
    assert broken == (["controller.decisions is 6, and in memory 5"] if missed else [])


@pytest.mark.parametrize(("slots", "age"), [(9, " (the metrics are as of slot 3)"), (10, "")])
def test_only_metrics_of_all_rows_of_a_run_that_was_cut_short_are_compared(
    slots: int, age: str, tmp_path: Path
) -> None:
    """With those of the same slots in memory; a folder that has no scenario yet is not looked at either."""
    case = SimulatedCase(1, SCENARIO, ())
    assert [*_of_folder(case, SimulatedRun(tmp_path), tmp_path, done=False)] == []
    write_resolved(tmp_path, SCENARIO)
    assert [*_of_metrics(case, tmp_path, {"slots": slots, "ended": f"it failed{age}"})] == []


def test_what_was_not_recomputed_is_not_verified() -> None:
    """A run that is cut short at once has recomputed nothing."""
    entry = {"recomputed_trials": 0, "verified": [], "own_word": []}
    summary = {"mode": "live", "wall_seconds": 0.1, "misdelivered": {}, "verification": {"legitimate": entry}}
    assert [*wrong_course(summary, verification_of(SCENARIO, ()), 1.0, 0)] == []


@pytest.mark.parametrize(("metrics", "rows", "missed"), [(20, 10, True), (20, 20, False), (10, 0, False)])
def test_metrics_are_of_rows_that_are_there(metrics: int, rows: int, missed: bool, tmp_path: Path) -> None:
    """But for the first ones, which are written before their rows count."""
    unfinished = tmp_path / "results" / "unfinished"
    unfinished.mkdir(parents=True)
    (unfinished / "summary.json").write_text(json.dumps({"slots": metrics}))
    (unfinished / "rounds").write_bytes(json.dumps({"at": "slot 9", "slots": rows, "tables": {}}).encode() + b"\n")
    broken = judged(tmp_path, {CutPower("disk", 60): 0.5}, status=-9)
    assert (f"there are metrics of {metrics} slots, and rows of {rows}" in broken) is missed


@pytest.mark.parametrize(
    ("mistake", "status", "said", "missed"),
    [
        ("no JSON", 3, "evedrop: robot/pose: expected JSON such as [1.0, 2.0]", False),
        ("no JSON", 3, "evedrop: sensor was ended by signal 9", True),
        ("no JSON", 0, "", True),
        ("a flood", 3, "evedrop: robot/pose: the program sends faster than the run", False),
        ("a flood", 0, "", False),
        ("a flood", 3, "evedrop: sensor was ended by signal 9", True),
    ],
)
def test_a_program_that_is_wrong_ends_its_run(
    mistake: str, status: int, said: str, missed: bool, tmp_path: Path
) -> None:
    """But a short run may have its states before a flood is too much."""
    program = DrawnProgram(True, "list", mistake)
    broken = judged(tmp_path, {}, program=program, status=status, said=said)
    assert any("although a program is wrong" in miss for miss in broken) is missed


@pytest.mark.parametrize(("moment", "missed"), [(0.71, False), (0.69, True)])
def test_a_slot_that_is_sent_before_it_is_due_is_a_miss(moment: float, missed: bool, tmp_path: Path) -> None:
    """Slot 5 is due half a second after the start, and a hold of a quarter of a second puts it off; it is noted at once."""
    put = [
        PutMessage(0.0, "control/sensor", "start"),
        PutMessage(0.1, "uplink", "1"),
        PutMessage(0.15, "uplink", "hold 2"),
        PutMessage(0.4, "control/sensor", "go 2"),
        PutMessage(0.41, "control/sensor", "go 2"),
        PutMessage(0.41, "uplink", "2"),
        PutMessage(moment, "uplink", "5"),
    ]
    broken = judged(tmp_path, {KILLED: 0.5}, status=3, put=put)
    assert ("slot 5 is sent 0.010 s before it is due" in broken) is missed


def test_an_outage_of_a_run_in_shards_names_its_shard() -> None:
    """That of any other run names none."""
    entry = {"process": "sensor", "slot": 1, "until": 2, "seconds": 0.1}
    miss = "an outage of sensor in shard None of 2"
    for shards, missed in ((1, False), (2, True)):
        scenario = Scenario({**SCENARIO.as_tables(), "trials": 2, "shards": shards})
        reference = RunReference(scenario, {"slots": 10}, {})
        summary = {"ended": "complete", "outages": [entry]}
        assert (miss in [*wrong_outages(summary, reference, frozenset())]) is missed


_CASE = {
    "seed": 1,
    "ahead": 5,
    "scenario": {
        "title": "Drawn",
        "slots": 20,
        "pace": 0.3,
        "longest_outage": 3.0,
        "process": {"A": [[1.0]], "Q": [[0.01]], "initial_covariance": [[1.0]]},
        "encoding": {"scheme": "plain"},
        "legitimate": {"link": {"quality": 1.0}},
        "plant": {"inputs": ["u"], "input_matrix": [[0.1]], "noise": [[0.0001]]},
        "controller": {
            "strategy": "lqr",
            "state_weights": [1.0],
            "input_weights": [0.1],
            "period": 2,
            "acts_on": "truth",
        },
    },
}


_KILL = ["kill", "legitimate", 300, None]


def _after(change: Callable[[SimulatedRun], None]) -> Callable[..., list[str]]:
    """The judge, once somebody has changed the results."""

    def judge(case: SimulatedCase, run: SimulatedRun, *rest: Any) -> list[str]:
        change(run)
        return misses(case, run, *rest)

    return judge


def _without_log(run: SimulatedRun) -> None:
    (run.folder / "logs" / "sensor.log").unlink()


def _summary_with(**entries: Any) -> Callable[[SimulatedRun], None]:
    def change(run: SimulatedRun) -> None:
        path = run.folder / "summary.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))

    return change


def _untold(run: SimulatedRun) -> None:
    run.told.clear()


def _without_theory(run: SimulatedRun) -> None:
    peers = json.loads((run.folder / "summary.json").read_text())["peers"]
    _summary_with(peers={**peers, "legitimate": {**peers["legitimate"], "theoretical_trace_covariance": 123.0}})(run)


def _with_another_slot_count(run: SimulatedRun) -> None:
    path = run.folder / "scenario.toml"
    path.write_text(path.read_text().replace("slots = 20", "slots = 19"))


def _on_its_word(run: SimulatedRun) -> None:
    verification = json.loads((run.folder / "summary.json").read_text())["verification"]
    entry = verification["legitimate"]
    changed = {**entry, "verified": entry["own_word"], "own_word": entry["verified"]}
    _summary_with(verification={"legitimate": changed})(run)


def _with_decisions(run: SimulatedRun) -> None:
    controller = json.loads((run.folder / "summary.json").read_text())["controller"]
    _summary_with(controller={**controller, "decisions": 11})(run)


def _outage(process: str, until: int | None) -> dict[str, object]:
    return {"process": process, "slot": 1, "until": until, "seconds": 0.1, "shard": None}


@pytest.mark.parametrize(
    ("fault", "change", "miss"),
    [
        (None, _without_log, "there is no logs/sensor.log"),
        (None, _with_decisions, "the controller has decided 11 times, once in 2 of 20 slots"),
        (["confuse", "sensor", 100, None], _summary_with(misdelivered={}), "sensor has got 1 messages of other keys"),
        (
            ["cut", "recorder", 100, 0.1],
            _summary_with(outages=[_outage("router", 4)]),
            "the recorder was cut off, which sees nobody then, and the summary lists outages of router",
        ),
        (
            ["cut", "legitimate", 100, None],
            _summary_with(outages=[_outage("legitimate", 4)]),
            "legitimate is cut off for good, and the summary has its outage end at slot 4",
        ),
        (
            ["cut", "legitimate", 100, 1.0],
            _summary_with(outages=[_outage("legitimate", 4)]),
            "the outage of legitimate lasts 0.10 s after cut legitimate for 1.00 s after 100 events",
        ),
        (["kill", "legitimate", 380, None], _summary_with(slots=1), "slots were done 4.0 s before kill legitimate"),
        (
            ["stop and kill", "legitimate", 380, 0.1],
            _summary_with(slots=1),
            "slots were done 4.0 s before stop and kill",
        ),
        (["refuse a write to", "disk", 430, None], _summary_with(slots=1), "slots were done 4.0 s before refuse"),
        (None, _summary_with(mode="exact"), "the mode of a live run is exact"),
        (None, _summary_with(wall_seconds=-5.0), "wall_seconds is -5.0, and the run took"),
        (
            None,
            _summary_with(misdelivered={"sensor": 5}),
            "the summary has 5 messages of other keys, and 0 were confused",
        ),
        (None, _on_its_word, "own_word of legitimate is"),
        (None, _untold, "the run tells no progress"),
        (None, _with_another_slot_count, "scenario.toml has slots = 19, and the run 20"),
        (_KILL, _summary_with(seed=99), "seed is 99, not"),
        (_KILL, _summary_with(scenario="another"), "scenario is another, not Drawn"),
        (_KILL, _summary_with(first_trial=7), "first_trial is 7, not"),
        (_KILL, _without_theory, "theoretical_trace_covariance is 123.0"),
        (
            _KILL,
            _summary_with(ended="the moon was full"),
            "and its summary: the moon was full",
        ),
        (
            ["interrupt", "launcher", 300, None],
            _summary_with(ended="the moon"),
            "was interrupted, and the summary says: the moon",
        ),
        (
            ["ask for the status of", "run", 200, None],
            _summary_with(outages=[_outage("legitimate", 4)]),
            "an outage of legitimate at slot 1, and no fault caused one",
        ),
        (
            ["cut", "legitimate", 100, 0.1],
            _summary_with(outages=[{**_outage("legitimate", 4), "seconds": 1e6}]),
            "an outage of 1000000.0 s in a run of",
        ),
    ],
)
def test_what_results_must_say_and_do_not_is_a_miss(
    fault: list[object] | None, change: Callable[[SimulatedRun], None], miss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody changes the results of a run that keeps all promises."""
    case = read_case(json.dumps({**_CASE, "faults": [fault] if fault else []}))
    assert play(case).misses == ()

    monkeypatch.setattr(campaign, "misses", _after(change))
    assert any(miss in broken for broken in play(case).misses)


def test_a_write_that_is_shortened_excuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rest is written: what else ends the run costs no rows that it has told of."""
    case = read_case(json.dumps({**_CASE, "faults": [["shorten a write to", "disk", 60, None], _KILL]}))
    assert play(case).misses == ()
    monkeypatch.setattr(campaign, "misses", _after(_summary_with(slots=1)))
    assert any("slots were done, and the summary has 1" in broken for broken in play(case).misses)
