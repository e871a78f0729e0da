"""Wires of the simulated campaign: drawn from a seed, played again by it, and judged by what their receivers got."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.scenario.tables import Scenario
from evedrop.scenario.words import toml_text
from evedrop.virtual import notes
from evedrop.virtual.cases import case_of
from evedrop.virtual.faults import CutConnection, CutPower, FillDisk, KillProcess, StopProcess
from evedrop.virtual.run import SimulatedRun
from evedrop.virtual.world import EPOCH
from evedrop.wire.file import wire_of
from evedrop.wire.liveliness import LivelinessRelay
from evedrop.wire.publications import _Way
from evedrop.wire.running import RunningWire
from evedrop.wire.running_link import RunningLink
from evedrop.wire.scenario_network import over_wire
from evedrop.wire.tallies import LinkTally
from evedrop.wire.time_steps import StepCounter
from tests.virtual import simulated, wire_damage, wire_scenarios
from tests.virtual.small_limits import FULL, HUNG, LIMITS
from tests.virtual.wire_cases import EVERY, USUAL_PROGRAMS, WIRE, SimulatedWireCase
from tests.virtual.wire_commands import (
    DAMAGED,
    FURTHER,
    JOINED,
    MOVED,
    OPENED,
    REPLAY,
    REPLAY_FILE,
    SCENARIO,
    VIEW,
    VIEW_FILE,
)
from tests.virtual.wire_damage import DAMAGES, Damage
from tests.virtual.wire_draws import BASE, ENDPOINTS, FIELD, ROBOT, SIDES, file_of
from tests.virtual.wire_judge import DISK, WireJudge
from tests.virtual.wire_mistakes import MISTAKES, TRIALS
from tests.virtual.wire_programs import Course, WireProgram

_TAPPED = """
[side.robot]
listen = "tcp/127.0.0.1:17501"

[side.field]
connect = "tcp/127.0.0.1:17600"

[[link]]
from = "robot"
to = "field"
tap = true
duplicate = 0.5
"""
PLAIN = SimulatedWireCase(1, (), starts=2, seconds=10.0)
NUMBERED, TALLIED, MESSAGE, COUNTED = RunningLink._counted, LinkTally.add, _Way.message, StepCounter.add


@pytest.mark.parametrize(
    "seed", [EVERY, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(2 * EVERY, 9 * EVERY, EVERY))]
)
def test_a_wire_of_a_seed_keeps_its_promises(seed: int) -> None:
    """It is the same case each time, and can be written down."""
    case = simulated.any_case(seed)
    assert isinstance(case, SimulatedWireCase)
    assert simulated.read_case(case.to_text()) == case == simulated.read_case(str(seed))
    assert simulated.play(case).misses == ()


@pytest.mark.campaign
def test_a_seed_decides_a_wire_again() -> None:
    """To the last event; another seed is another wire."""
    case = SimulatedWireCase(3, (KillProcess(WIRE, 300), CutConnection(BASE, 700, 2.0)), starts=2, seconds=10.0)
    first, again, other = case.play(), case.play(), replace(case, seed=4).play()
    assert first.run.digest == again.run.digest != other.run.digest
    assert first.misses == again.misses == ()


@pytest.mark.campaign
@pytest.mark.parametrize("what", [what for what in FURTHER if what not in LIMITS])
def test_what_is_done_besides_is_the_same_again(what: str) -> None:
    """No random name of a file gets into the events."""
    case = replace(PLAIN, further=(what,))
    first, again = case.play(), case.play()
    assert first.run.digest == again.run.digest


@pytest.mark.campaign
def test_no_messages_that_go_round_are_duplicated() -> None:
    """A wire whose sides are joined outside would have millions of them."""
    joined = [case for case in map(SimulatedWireCase.of, range(600)) if JOINED in case.further]
    assert joined
    assert not any("duplicate" in f"{case.file} {case.operations}" for case in joined)


def test_other_seeds_are_runs_as_before() -> None:
    """The wires take none of the draws of runs."""
    assert simulated.any_case(EVERY + 1) == case_of(EVERY + 1)


@pytest.mark.campaign
@pytest.mark.parametrize(
    "fault",
    [
        KillProcess(WIRE, 0),
        StopProcess(WIRE, 0, 15.0),
        CutConnection(BASE, 0, 1.0),
        FillDisk(DISK, 0, 3.0),
        CutPower(DISK, 0),
    ],
    ids=lambda fault: fault.kind,
)
def test_a_fault_at_any_moment_breaks_no_promise(fault: Any) -> None:
    """Also while the wire starts, and while it ends."""
    for after in (30, 300, 850):
        assert replace(PLAIN, faults=(replace(fault, after=after),)).play().misses == (), after


def test_a_message_that_zenoh_drops_at_a_tap_is_no_miss() -> None:
    """Where a connection is full, the second copy of a message is dropped, and the journal calls both delivered."""
    case = SimulatedWireCase(
        1,
        (),
        seconds=3.0,
        file=_TAPPED,
        programs=(WireProgram(ROBOT, ("large robot/large",)), WireProgram(FIELD, ("listen **",))),
        further=(FULL,),
    )
    played = case.play(keep=True)
    assert any(note.what == notes.LOST and note.words[-1] == notes.NO_ROOM for note in played.run.happened)
    assert played.misses == ()


@pytest.mark.parametrize("trial", TRIALS)
def test_what_may_be_in_a_file_is_named(trial: str) -> None:
    """A mistake with the status of a wrong use, and nothing is left; without it, the file is a wire."""
    tables = file_of(random.Random(1), 1.0)  # noqa: S311 - to be repeated
    case = SimulatedWireCase(1, (), file=toml_text(tables), programs=(), trials=(trial,))
    assert simulated.read_case(case.to_text()) == case
    assert case.play().misses == ()
    assert wire_of(tables).links


def test_a_mistake_that_is_not_named_is_seen() -> None:
    """What an error must name is really looked for."""
    case = SimulatedWireCase(1, (), seconds=1.0, trials=("a negative seed",))
    assert case.play().misses == ()
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(MISTAKES, "a negative seed", lambda _: "link.7.keys")
        assert any("status 0 for a file with a negative seed" in miss for miss in case.play().misses)


@pytest.mark.campaign
def test_a_link_is_fitted_whose_messages_were_heard_at_once() -> None:
    """A wire that was suspended for most of its time: there is no time between its messages, and so no rate."""
    case = replace(PLAIN, faults=(StopProcess(WIRE, 30, 15.0),))
    assert case.play().misses == ()


def swallowing() -> Callable[..., Any]:
    """A wire that loses a message now and then."""
    numbers = count(1)
    return lambda *arguments: (lambda: None) if next(numbers) % 20 == 0 else MESSAGE(*arguments)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("place", "name", "mistake", "miss"),
    [
        (_Way, "message", swallowing(), "messages never arrived that the journal calls delivered"),
        (_Way, "message", lambda way, sample, _, by: MESSAGE(way, sample, 2, by), "arrived 2 times"),
        (RunningLink, "_counted", lambda *_: 0, "with gaps at [] and twice [0, 1, 2]"),
        (
            LinkTally,
            "add",
            lambda tally, some: TALLIED(tally, some[1:]),
            "status 3, although nothing of this may end a wire",
        ),
    ],
)
def test_a_mistake_of_the_wire_is_seen(
    place: type, name: str, mistake: Callable[..., Any], miss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing is disturbed."""
    assert PLAIN.play().misses == ()
    monkeypatch.setattr(place, name, mistake)
    assert any(miss in found for found in PLAIN.play().misses)


@pytest.mark.campaign
def test_recordings_count_what_the_journal_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """The view that the wire records, and the one that is made of its journal; one that forgets a message is seen."""
    case = replace(PLAIN, starts=1, further=(VIEW, REPLAY))
    assert simulated.read_case(case.to_text()) == case
    assert case.play().misses == ()
    monkeypatch.setattr(StepCounter, "add", lambda counter, rows: COUNTED(counter, rows[1:]))
    assert sorted(miss.partition(" counts ")[0] for miss in case.play().misses) == [REPLAY_FILE, VIEW_FILE]


@pytest.mark.campaign
def test_a_program_opens_the_wire_and_uses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It steers the wire and reads its journal; a summary that counts a message too many is seen."""
    case = replace(PLAIN, further=(OPENED,))
    assert case.play().misses == ()
    summary = RunningWire.summary
    monkeypatch.setattr(RunningWire, "summary", lambda wire: {"heard": summary(wire)["heard"] + 1})
    assert any("the summary heard" in miss for miss in case.play().misses)


@pytest.mark.campaign
def test_a_scenario_has_the_links_of_a_wire(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its packets have the fates of the wire's messages; those of a wire with another seed are seen."""
    radio = {"name": "radio", "from": ROBOT, "to": BASE, "quality": 0.5}
    file = toml_text({"seed": 7, "side": {ROBOT: {}, BASE: {}}, "link": [radio]})
    cases = [SimulatedWireCase(seed, (), file=file, further=(SCENARIO,)) for seed in range(1, 7)]
    assert not any(case.play().misses for case in cases)

    def other_seed(scenario: Scenario, *network: Any) -> dict[str, Any]:
        made = over_wire(scenario, *network)
        return {**made, "wire": {**made["wire"], "seed": 1}}

    monkeypatch.setattr(wire_scenarios, "over_wire", other_seed)
    miss = "legitimate does not get the packets that the link radio lets through"
    assert any(miss in case.play().misses for case in cases)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("what", "words"),
    [
        (JOINED, "messages pass between the sides robot and base outside the wire"),
        (MOVED, "was removed or moved while the wire ran"),
    ],
)
def test_a_wire_says_what_happens_to_it(what: str, words: str) -> None:
    """Sides that are joined outside, and a journal that somebody moves."""
    played = replace(PLAIN, starts=1, further=(what,)).play()
    assert played.misses == ()
    assert words in played.run.said


def test_no_message_is_delivered_after_the_wire_has_ended() -> None:
    """The wire ran until 2 s, and again until 5 s; a start in between was refused, and has no number in the journal."""
    judge = WireJudge(PLAIN, wire_of(PLAIN.tables), Course(ended=[2.0, 3.0, 5.0]), SimulatedRun(Path()), {})

    def row(heard: float, delay: float, fate: str = "delivered") -> dict[str, Any]:
        return {"key": "scan", "time": EPOCH + heard, "delay": delay, "fate": fate}

    in_time = [row(1.5, 0.4), row(3.5, 1.4), row(1.9, 0.4, "held up")]
    assert [*judge._too_early(in_time)] == []
    (miss,) = judge._too_early([*in_time, row(1.9, 0.4), row(4.9, 0.2), row(5.5, 0.0)])
    assert "ended before 3 messages of scan" in miss


@pytest.mark.campaign
def test_an_opener_without_power_has_not_read_all_errors() -> None:
    """The wire ended before, and said why; what a wire itself prints is complete."""
    process: Any = SimpleNamespace(task=SimpleNamespace(status=1), printed="evedrop: warning: no link leads back")
    for further, misses in (((OPENED,), 0), ((), 1)):
        case, run = replace(PLAIN, further=further), SimulatedRun(Path())
        judge = WireJudge(case, wire_of(case.tables), Course(), run, {CutPower(DISK, 0): 1.0})
        assert len([*judge._of_status(process)]) == misses


@pytest.mark.campaign
def test_the_history_of_a_lossless_topic_is_lossless() -> None:
    """Its keys share their numbers, and it is not delayed either."""
    tables = PLAIN.tables
    tables["link"] = [{"from": ROBOT, "to": BASE, "delay": {"model": "constant", "value": 0.03}}]
    file = toml_text({"side": tables["side"], "link": tables["link"], "lossless": f"{ROBOT}/data"})
    case = replace(PLAIN, file=file, programs=(WireProgram(ROBOT, (f"many {ROBOT}/data/@adv",)),))
    assert case.play().misses == ()


@pytest.mark.campaign
def test_a_wire_whose_zenoh_hangs_ends_by_itself() -> None:
    """And says where it hangs. The seed decides whether a question hangs."""
    several = [replace(PLAIN, seed=seed, starts=1, further=(HUNG,)).play() for seed in range(1, 9)]
    assert {played.misses for played in several} == {()}
    hung = [played.run.status for played in several if "nothing has moved at the side" in played.run.said]
    assert set(hung) == {3}


@pytest.mark.campaign
def test_programs_in_mode_peer_are_named() -> None:
    """Where a side lets them be there, only those that answer multicast scouting."""
    robot, base = USUAL_PROGRAMS[1], USUAL_PROGRAMS[0]
    tables = PLAIN.tables
    tables["side"][ROBOT]["peers"] = True
    for file in (PLAIN.file, toml_text(tables)):
        for how in ("quiet", "heard"):
            peer = replace(robot, does=(*robot.does, f"peer {how}"))
            played = replace(PLAIN, starts=1, file=file, programs=(base, peer)).play()
            assert played.misses == ()
            assert ("the wire has no verdict" in played.run.said) == (file == PLAIN.file or how == "heard")


@pytest.mark.campaign
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_folder_is_refused_by_name_or_used(damage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is recovered from what cannot be right; a refusal in other words, or none, is seen."""
    monkeypatch.setattr(wire_damage, "_EACH", 1)
    monkeypatch.setattr(wire_damage, "DAMAGES", {damage: DAMAGES[damage]})
    case = replace(PLAIN, starts=1, seconds=2.0, further=(DAMAGED,))
    assert case.play().misses == ()
    change, named = DAMAGES[damage]
    other = Damage(change, "other words" if named is None else None)
    monkeypatch.setattr(wire_damage, "DAMAGES", {damage: other})
    assert [miss.partition(":")[0] for miss in case.play().misses] == [damage]


@pytest.mark.campaign
@pytest.mark.parametrize("limit", LIMITS)
def test_small_limits_break_no_promise(limit: str) -> None:
    """What they drop is in the journal, with the reason."""
    case = replace(SimulatedWireCase.of(8 * EVERY), further=())
    limited = replace(case, further=(limit,))
    assert limited.play().misses == case.play().misses == ()


@pytest.mark.campaign
def test_a_token_that_is_mirrored_hides_another_one_of_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh does not tell of the second one, so a side that shares no link with the holder of the first need not see it."""
    sides = {side: {"listen": ENDPOINTS[side]} for side in SIDES}
    links = [{"from": FIELD, "to": ROBOT}, {"from": ROBOT, "to": BASE}]
    programs = (
        WireProgram(FIELD, ("alive alive/all",)),
        WireProgram(ROBOT, ("alive alive/all",), after=1.5),
        WireProgram(BASE, ("watch alive/**",)),
    )
    case = SimulatedWireCase(1, (), seconds=12.0, file=toml_text({"side": sides, "link": links}), programs=programs)
    assert case.play().misses == ()
    earlier = replace(case, programs=(replace(programs[0], after=3.0), replace(programs[1], after=0.0), programs[2]))
    assert earlier.play().misses == ()
    monkeypatch.setattr(LivelinessRelay, "mirror", lambda _: None)
    alone = replace(case, programs=programs[1:])
    assert "the token alive/all of robot is not seen at base" in alone.play().misses


@pytest.mark.campaign
def test_a_failing_wire_is_shrunk_and_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What has nothing to do with the mistake is left out, and the diagram has the wire and its programs."""
    monkeypatch.setattr(RunningLink, "_counted", lambda *_: 0)
    case = SimulatedWireCase(5, (CutConnection(BASE, 300, 1.0),), starts=3, seconds=10.0)
    smaller = simulated.shrunk(case, case.play().misses)
    assert smaller == replace(case, faults=(), starts=2, seconds=1.0)
    assert not simulated.show(smaller)
    printed = capsys.readouterr().out
    assert f"--case '{smaller.to_text()}'" in printed
    assert all(name in printed for name in ("wire", "robot", "base", "MISS the journal numbers"))


@pytest.mark.parametrize("text", ['{"starts": 2}', '{"seed": 1, "starts": 1, "seconds": 1.0, "faults": [["melt"]]}'])
def test_what_is_no_wire_is_refused(text: str) -> None:
    """In the words of an error of usage."""
    with pytest.raises(UsageError, match="not a case"):
        simulated.read_case(text)
