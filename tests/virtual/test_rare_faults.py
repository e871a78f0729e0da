"""What the rarer faults of the simulated world do to a run, and that it keeps its promises."""

from __future__ import annotations

import random
import struct
from typing import Any

import msgpack
import pytest

from evedrop.cli.simulated import program
from evedrop.live.protocol.codec import enclosed, pack
from evedrop.model.receiver import Action
from evedrop.scenario.tables import Scenario
from evedrop.virtual import by_hand, notes, rereading
from evedrop.virtual.broken_messages import BreakMessage, broken
from evedrop.virtual.by_hand import RunByHand, RunWrongly, WriteBriefs
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase, case_from, case_of
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.rare_faults import RARE_KINDS, ReadMetrics, SteerRun, TakePort
from evedrop.virtual.rereading import RereadMessages
from tests.virtual.disturbed_runs import RELAYED, SCENARIO, disturbed

RUNS = 90
"""Events after which all processes are there."""


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("fault", "scenario", "status", "said"),
    [
        (TakePort("router", 1), RELAYED, 2, "--listen tcp/127.0.0.1:17460: Address already in use"),
        (TakePort("relay", 5), RELAYED, 3, "cannot listen at tcp/127.0.0.1:17461"),
        (BreakMessage("recorder", RUNS), SCENARIO, 3, "broke the protocol"),
        (BreakMessage("eve", RUNS + 1), SCENARIO, 3, "broke the protocol"),
        (ReadMetrics("run", RUNS), SCENARIO, 0, ""),
        (RereadMessages("run", 1), RELAYED, 0, ""),
        (SteerRun("run", RUNS), SCENARIO, 0, ""),
        *((WriteBriefs(what, RUNS), SCENARIO, 0, "") for what in dict.fromkeys(WriteBriefs.targets(SCENARIO))),
        (WriteBriefs("briefs for a host", RUNS), RELAYED, 0, ""),
        (WriteBriefs("briefs with wrong options", RUNS), RELAYED, 0, ""),
        *((RunWrongly(what, RUNS), SCENARIO, 0, "") for what in RunWrongly.targets(SCENARIO)),
        *((RunWrongly(what, RUNS), RELAYED, 0, "") for what in RunWrongly.targets(RELAYED)),
    ],
    ids=str,
)
def test_a_run_ends_as_it_must(fault: Disturbance, scenario: Scenario, status: int, said: str) -> None:
    """With the right status and words."""
    run = disturbed(fault, scenario=scenario).run
    assert (run.status, said in run.said) == (status, True), run.said


def test_a_reader_that_fails_on_a_wrong_message_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """If its error names no sender."""

    def read(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(rereading, "read_command", read)
    played = play_case(SimulatedCase(1, SCENARIO, (RereadMessages("run", 1),)), program)
    assert [miss for miss in played.misses if "ZeroDivisionError" in miss]


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(12))
def test_a_wrong_brief_ends_its_process_alone(seed: int) -> None:
    """Whichever entry is wrong: the run goes on."""
    played = disturbed(WriteBriefs("briefs", RUNS), seed=seed)
    ends = [note.words for note in played.run.happened if note.what == notes.ENDS and note.words[0] == "by hand"]
    assert 0 < len(ends) <= 3 * 30  # until time is up
    assert {status for _, status in ends} <= {2, 3, 130, -9}
    assert played.run.status == 0


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("what", "status"),
    [
        ("a run", 0),
        ("a run that begins paused", 0),
        ("a run without a receiver", 3),
        ("a run that is interrupted", 130),
        ("a run with a wrong password", 3),
        ("a run that is recorded for views", 0),
        ("a run with certificates", 0),
        ("a run with a brief of another run", 3),
        ("a run where another program listens", 2),
        ("a run with a wrong clock", 3),
        ("a run with the certificate of another process", 3),
        ("a run at another name", 2),
    ],
)
def test_a_run_by_hand_ends_as_it_must(what: str, status: int) -> None:
    """Beside the other one."""
    happened = disturbed(RunByHand(what, RUNS), scenario=Scenario({**SCENARIO.as_tables(), "slots": 20})).run.happened
    ends = {note.words[0]: note.words[1] for note in happened if note.what == notes.ENDS}
    assert ends["recorder by hand"] == status
    assert ends["recorder"] == 0


@pytest.mark.parametrize("seed", range(40))
def test_a_broken_message_has_the_right_envelope_and_a_wrong_field(seed: int) -> None:
    """Of any type."""
    key, fields = "evedrop/r/uplink", {"k": 3, "z": b"\0" * 16, "m": {"a": 1}, "l": [{"b": 2}]}
    message = enclosed(key, pack(fields))
    other = broken(random.Random(seed), message)  # noqa: S311 - to be repeated, not to be secret
    assert other != message
    head = enclosed(key, b"")
    assert other.startswith(head)
    msgpack.unpackb(other[len(head) :], strict_map_key=False)  # it can be read


def test_what_no_reader_can_check_is_wrong_in_its_length_alone() -> None:
    """Digests, and numbers unless the reader holds them against others; a sum may be below 0 in any case."""
    digests, sums = bytes(range(16)), struct.pack("<2d", 1.0, 2.0)
    fields = {"k": 0, "c": 1, "action": b"\1", "digests": {0: digests}, "trace": sums}
    message = enclosed("evedrop/r/telemetry/eve", pack(fields))
    head = enclosed("evedrop/r/telemetry/eve", b"")
    some = random.Random(1)  # noqa: S311 - to be repeated, not to be secret
    below = 0
    for _ in range(2000):
        wrong = msgpack.unpackb(broken(some, message)[len(head) :], strict_map_key=False)
        if not isinstance(wrong, dict):
            continue
        other = wrong["digests"].get(0) if isinstance(wrong.get("digests"), dict) else None
        assert not isinstance(other, bytes) or other == digests or len(other) != len(digests)
        action = wrong.get("action")
        assert not isinstance(action, bytes) or len(action) != 1 or action in {b"\1", b"\xff"}
        below += wrong.get("trace") == sums[:8] + struct.pack("<d", -1.0)
    assert below > 0


def test_a_wrong_action_says_of_a_packet_that_it_was_lost_or_was_not() -> None:
    """What a receiver did with one that arrived, the recorder cannot know."""
    fields, key = {"k": 0, "c": 3, "action": b"\0\2\3"}, "evedrop/r/telemetry/eve"
    some = random.Random(1)  # noqa: S311 - to be repeated, not to be secret
    wrong = set()
    for _ in range(500):
        other = msgpack.unpackb(broken(some, enclosed(key, pack(fields)), checked=True)[len(enclosed(key, b"")) :])
        action = other.get("action") if isinstance(other, dict) else None
        wrong |= {action} if isinstance(action, bytes) and len(action) == 3 else set()
    assert {action for action in wrong if max(action) <= max(Action)} - {fields["action"]} == {
        b"\1\2\3",
        b"\0\0\3",
        b"\0\2\0",
    }


@pytest.mark.campaign
def test_all_are_drawn_and_written_down() -> None:
    """In some of the first seeds."""
    cases = [case_of(seed) for seed in range(1, 600)]
    rare = [case for case in cases if any(type(fault) in RARE_KINDS.values() for fault in case.faults)]
    assert {type(fault) for case in rare for fault in case.faults} >= {*RARE_KINDS.values()}
    for case in rare:
        assert case_from(case.to_text()) == case


@pytest.mark.parametrize("seed", range(50))
def test_a_wrong_brief_names_no_other_path(seed: int) -> None:
    """It would be outside the simulated disk: in the folder in which the tests run, or anywhere."""
    brief: dict[str, Any] = {"part": {"results": "/results"}}
    by_hand._break(random.Random(seed), brief, ["part", "results"])  # noqa: S311 - to be repeated, not to be secret
    assert not isinstance(brief["part"].get("results"), str)
