"""A program gives the states of simulated runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from evedrop.cli.simulated import program
from evedrop.results.folder import STATES
from evedrop.scenario.tables import Scenario
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import SimulatedCase, case_from, case_of
from evedrop.virtual.faults import CutConnection
from evedrop.virtual.programs import MISTAKES, DrawnProgram, state, taken_states

SCENARIO = Scenario(
    {
        "title": "States of a program",
        "slots": 12,
        "longest_outage": 10.0,
        "process": {
            "A": [[1.0, 0.1], [0.0, 1.0]],
            "Q": [[0.01, 0.0], [0.0, 0.01]],
            "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
            "source": "file",
            "states": ["x", "v"],
            "state_values": [[0.5 * slot, -0.25 * slot] for slot in range(12)],
        },
        "encoding": {"scheme": "innovation", "state_probability": 0.3},
        "legitimate": {"link": {"quality": 0.9}},
        "eavesdroppers": {"eve": {"strategy": "smart", "link": {"quality": 0.9}}},
    }
)
PROGRAM = DrawnProgram(listens=True, form="object")


@pytest.mark.parametrize("form", ["object", "list", "bytes"])
@pytest.mark.parametrize("listens", [True, False])
def test_a_run_takes_the_states_of_a_program(form: str, listens: bool) -> None:
    """All of them, as in memory."""
    played = play_case(SimulatedCase(1, SCENARIO, (), program=DrawnProgram(listens, form)), program)
    assert (played.misses, played.run.status) == ((), 0)


def test_a_run_goes_on_with_later_states_after_a_cut() -> None:
    """The program does not send the lost ones again."""
    cut = CutConnection("sensor", 4, 0.3, "messages of the sensor")
    played = play_case(SimulatedCase(1, SCENARIO, (cut,), program=PROGRAM), program)
    assert (played.misses, played.run.status, {*played.struck}) == ((), 0, {cut})


@pytest.mark.parametrize(
    "mistake", [pytest.param(one, marks=pytest.mark.campaign if one == "a flood" else ()) for one in MISTAKES]
)
def test_a_wrong_program_ends_the_run(mistake: str) -> None:
    """With status 3, and words that say what it did; the judge misses either."""
    wrong = replace(PROGRAM, form="bytes" if mistake == "too few bytes" else "list", mistake=mistake, right=0)
    played = play_case(SimulatedCase(1, SCENARIO, (), program=wrong), program)
    assert (played.misses, played.run.status) == ((), 3)
    right = play_case(SimulatedCase(1, SCENARIO, (), program=replace(wrong, mistake="")), program)
    assert (right.misses, right.run.status) == ((), 0)


def test_states_that_were_not_published_are_missed(tmp_path: Path) -> None:
    """Also one that comes twice, and, where nothing happened, one that is left out."""
    published = [state(SCENARIO, number) for number in range(20)]

    def wrong(numbers: list[int], *, disturbed: bool) -> bool:
        lines = [",".join(map(repr, published[number])) for number in numbers]
        (tmp_path / STATES).write_text("\n".join(["x,v", *lines]) + "\n")
        return bool(taken_states(tmp_path, SCENARIO, disturbed=disturbed)[2])

    assert not wrong([3, 4, 5], disturbed=False)
    assert wrong([3, 5], disturbed=False)
    assert not wrong([3, 5, 15], disturbed=True)
    assert wrong([3, 3], disturbed=True)
    assert wrong([4, 3], disturbed=True)


@pytest.mark.campaign
def test_programs_are_drawn_and_written_down() -> None:
    """With and without mistakes."""
    cases = [case for case in map(case_of, range(1, 600)) if case.program is not None]
    assert len({case.program.mistake for case in cases if case.program is not None}) > 3
    for case in cases:
        assert case_from(case.to_text()) == case
        assert str(case.program) in str(case)
