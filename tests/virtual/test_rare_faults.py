"""What the rarer faults of the simulated world do to a run, and that it keeps its promises."""

from __future__ import annotations

import random

import msgpack
import pytest

from evedrop.live.protocol.codec import enclosed, pack
from evedrop.scenario.tables import Scenario
from evedrop.virtual import notes
from evedrop.virtual.broken_messages import BreakMessage, broken
from evedrop.virtual.by_hand import RunByHand, WriteBriefs
from evedrop.virtual.cases import case_from, case_of
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.rare_faults import RARE_KINDS, ReadMetrics, SteerRun, TakePort
from tests.virtual.disturbed_runs import RELAYED, SCENARIO, disturbed

RUNS = 90
"""Events after which all processes are there."""


@pytest.mark.parametrize(
    ("fault", "scenario", "status", "said"),
    [
        (TakePort("router", 1), RELAYED, 2, "--listen tcp/127.0.0.1:17460: Address already in use"),
        (TakePort("relay", 5), RELAYED, 3, "cannot listen at tcp/127.0.0.1:17461"),
        (BreakMessage("recorder", RUNS), SCENARIO, 3, "broke the protocol"),
        (BreakMessage("eve", RUNS), SCENARIO, 3, "broke the protocol"),
        (ReadMetrics("run", RUNS), SCENARIO, 0, ""),
        (SteerRun("run", RUNS), SCENARIO, 0, ""),
        *((WriteBriefs(what, RUNS), SCENARIO, 0, "") for what in dict.fromkeys(WriteBriefs.targets(SCENARIO))),
        (WriteBriefs("briefs for a host", RUNS), RELAYED, 0, ""),
    ],
    ids=str,
)
def test_a_run_ends_as_it_must(fault: Disturbance, scenario: Scenario, status: int, said: str) -> None:
    """With the right status and words."""
    run = disturbed(fault, scenario=scenario).run
    assert (run.status, said in run.said) == (status, True), run.said


@pytest.mark.parametrize("seed", range(12))
def test_a_wrong_brief_ends_its_process_alone(seed: int) -> None:
    """Whichever entry is wrong: the run goes on."""
    played = disturbed(WriteBriefs("briefs", RUNS), seed=seed)
    ends = [note.words for note in played.run.happened if note.what == notes.ENDS and note.words[0] == "by hand"]
    assert len(ends) == 4
    assert {status for _, status in ends} <= {2, 3, -9}
    assert played.run.status == 0


@pytest.mark.parametrize(
    ("what", "status"),
    [
        ("a run", 0),
        ("a run without a receiver", 3),
        ("a run that is interrupted", 130),
        ("a run with a wrong password", 3),
        ("a run that is recorded for views", 0),
        ("a run with certificates", 0),
        ("a run with a brief of another run", 3),
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


def test_all_are_drawn_and_written_down() -> None:
    """In some of the first seeds."""
    cases = [case_of(seed) for seed in range(1, 600)]
    rare = [case for case in cases if any(type(fault) in RARE_KINDS.values() for fault in case.faults)]
    assert {type(fault) for case in rare for fault in case.faults} >= {*RARE_KINDS.values()}
    for case in rare:
        assert case_from(case.to_text()) == case
