"""`[nemesis]`: all mistakes at once; what a correct one does; and that each receiver has random draws of its own."""

from __future__ import annotations

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.cli.api import montecarlo, run
from evedrop.errors import ScenarioError
from evedrop.model.slot.link import NEVER
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from tests.builders import listener, mistakes_of, places_of, scalar_tables
from tests.examples import examples
from tests.golden.pages import Golden

NEMESIS: dict[str, Any] = {"faults": ["kill", "pause", "cut"], "every": 20, "lasting": 8}
LOOP: dict[str, Any] = {
    "plant": {"inputs": ["u"], "input_matrix": [[0.1]], "noise": [[1e-4]]},
    "controller": {"strategy": "lqr", "state_weights": [1.0], "input_weights": [0.1]},
}


def disturbed(nemesis: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """A scenario with this nemesis."""
    eavesdroppers = {
        "eve": listener("smart", 0.9),
        "mallory": listener("naive", 0.9),
    }
    made = scalar_tables(0.9, 0.1, slots=1000, seed=4, eavesdroppers=eavesdroppers)
    return {**made, "nemesis": {**NEMESIS, **(nemesis or {})}, **more}


def right(nemesis: dict[str, Any] | None = None, **more: Any) -> Scenario:
    """A scenario with which nothing is wrong."""
    return checked(disturbed(nemesis, **more), "file")


def happening(scenario: Scenario, name: str) -> list[tuple[int, int | None, str]]:
    """What happens to a receiver, in order: from, to, and what."""
    return sorted((event.first, event.to, event.kind) for event in scenario.event if name in event.names)


WRONG: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no such fault": (
        {"faults": ["kil"]},
        ["nemesis.faults.0"],
    ),
    "nothing to do": (
        {"faults": []},
        ["nemesis.faults"],
    ),
    "too often": ({"every": 0.5}, ["nemesis.every"]),
    "two at once": (
        {"lasting": "long", "evry": 3},
        ["nemesis.lasting", "nemesis.evry"],
    ),
    "nobody": ({"targets": ["router"]}, ["nemesis.targets.0"]),
    "twice": ({"targets": ["eve", "eve"]}, ["nemesis.targets"]),
    "after the end": (
        {"from": 1000, "to": 1001},
        ["nemesis.from", "nemesis.to"],
    ),
    "ends before": ({"from": 9, "to": 9}, ["nemesis.to"]),
    "set to nothing": ({"faults": ["set"]}, ["nemesis.set"]),
    "set without it": ({"set": {"quality": 0.1}}, ["nemesis.set"]),
    "state of nobody": ({"faults": ["cut"], "state": "last"}, ["nemesis.state"]),
    "wrong change": (
        {"faults": ["set"], "set": {"quality": 1.2}},
        ["nemesis.set.quality"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_told_with_their_path(case: str, golden: Golden) -> None:
    """What was found, what was expected; several at once."""
    nemesis, places = WRONG[case]
    mistakes = mistakes_of(right, nemesis)
    assert sorted(places_of(mistakes)) == sorted(places)
    golden("check", mistakes)


def test_mistakes_elsewhere_are_told_beside_those_of_a_nemesis() -> None:
    """All at once, as everywhere: those of entries, and then those across tables."""
    with pytest.raises(ScenarioError) as caught:
        right({"every": 0.5, "targets": ["router"]}, slots=0)
    assert [line.partition(":")[0] for line in caught.value.mistakes] == ["slots", "nemesis.every"]
    with pytest.raises(ScenarioError) as caught:
        right({"faults": ["set"], "set": {"quality": 2.0}, "targets": ["legitimate", "router"]}, record_trials=2)
    assert len(caught.value.mistakes) == 3


def test_more_faults_than_events_are_refused() -> None:
    """Before all of them are drawn."""
    with pytest.raises(ScenarioError, match=r"nemesis.every: comes to more than 10000 events; expected fewer faults"):
        right({"every": 2, "lasting": 1}, slots=100_000_000)


def test_a_nemesis_becomes_events(tmp_path: Path) -> None:
    """They are in the resolved scenario in place of it, so that running that again is the same run."""
    scenario = right()
    assert scenario.nemesis is None
    assert len(scenario.event) > 50
    assert {event.kind for event in scenario.event} == {"kill", "pause", "cut"}
    assert [event.first for event in scenario.event] == sorted(event.first for event in scenario.event)
    write_resolved(tmp_path, scenario)
    assert "nemesis" not in tomllib.loads((tmp_path / "scenario.toml").read_text(encoding="utf-8"))
    assert load(tmp_path).event == scenario.event


def test_faults_come_as_often_and_last_as_long_as_is_said() -> None:
    """Gaps and lengths have their means, within five standard errors, and all kinds are as frequent."""
    nemesis = {"faults": ["kill", "cut"], "every": 30, "lasting": 12, "targets": ["eve"]}
    scenario = right(nemesis, slots=40_000)
    spans = happening(scenario, "eve")
    lengths = [(to or NEVER) - start for start, to, _ in spans[:-1]]
    gaps = [after[0] - (before[1] or NEVER) for before, after in pairwise(spans)]
    for durations, mean in ((lengths, 12.0), (gaps, 30.0)):
        standard_deviation = (mean * (mean - 1.0)) ** 0.5
        assert abs(sum(durations) / len(durations) - mean) < 5.0 * standard_deviation / len(durations) ** 0.5
        assert min(durations) == 1
    kills = sum(kind == "kill" for _, _, kind in spans)
    assert abs(kills - len(spans) / 2) < 2.5 * len(spans) ** 0.5


def test_nobody_draws_for_anybody_else() -> None:
    """A further eavesdropper, or one less, moves no fault of others; the seed of the nemesis, if it has one, decides alone."""
    every = {"faults": ["kill", "pause", "cut", "partition"]}
    all_of_them = right(every)
    alone = right(every, eavesdroppers={"mallory": disturbed()["eavesdroppers"]["mallory"]})
    for name in ("legitimate", "mallory"):
        assert happening(alone, name) == happening(all_of_them, name)
    assert happening(right({"targets": ["eve"]}), "eve") == happening(right(), "eve")
    assert right(seed=5).event != right(seed=4).event
    assert right({"seed": 9}, seed=5).event == right({"seed": 9}, seed=4).event


def test_faults_stay_within_their_time_and_their_targets() -> None:
    """All begin and end from `from` to `to`, and happen to the targets alone."""
    scenario = right({"faults": ["kill", "partition"], "from": 100, "to": 400, "targets": ["eve", "legitimate"]})
    assert {name for event in scenario.event for name in event.names} == {"eve", "legitimate"}
    assert all(100 <= event.first < (event.to or NEVER) <= 400 for event in scenario.event)
    assert {event.kind for event in scenario.event} == {"kill", "partition"}


def test_a_nemesis_keeps_clear_of_what_the_file_does() -> None:
    """Nothing happens to a receiver while an event of the file has it, and what must not happen to it never does."""
    own = [
        {"from": 200, "to": 400, "cut": "eve"},
        {"at": 600, "kill": "mallory"},
        {"at": 10, "link": "eve", "set": {"quality": 0.5}},
    ]
    scenario = right({"faults": ["cut", "set"], "set": {"quality": 0.1}}, event=own)
    assert [event.kind for event in scenario.event[:3]] == ["cut", "kill", "set"]
    drawn = scenario.event[3:]
    assert not [event for event in drawn if "eve" in event.names and event.first <= 400 and (event.to or 0) >= 200]
    assert not [event for event in drawn if "mallory" in event.names and (event.to or 0) >= 600]
    assert {event.kind for event in drawn if "eve" in event.names} == {"cut"}
    assert {event.kind for event in drawn if "legitimate" in event.names} == {"cut", "set"}


def test_a_loop_keeps_its_estimator() -> None:
    """Where a controller waits for the legitimate estimate it is neither killed nor paused; if nothing is left, that is said."""
    scenario = right(**LOOP)
    assert {kind for _, _, kind in happening(scenario, "legitimate")} == {"cut"}
    assert {kind for _, _, kind in happening(scenario, "eve")} == {"kill", "pause", "cut"}
    with pytest.raises(
        ScenarioError, match=r"nemesis.faults: none of them may happen to any of the targets; expected cut"
    ):
        right({"faults": ["kill"], "targets": ["legitimate"]}, **LOOP)


def test_who_is_told_a_state_is_there_to_hear_it() -> None:
    """A receiver that learns a true state is not away in that slot."""
    spy = {"strategy": "replay-informed", "reads_as": "smart", "learns_at": 500, "link": {"quality": 0.9}}
    away = [
        event
        for seed in range(10)
        for event in right({"lasting": 60, "faults": ["kill", "pause"]}, eavesdroppers={"spy": spy}, seed=seed).event
        if "spy" in event.names
    ]
    assert len(away) > 50
    assert not [event for event in away if event.first <= 500 < (event.to or NEVER)]


def test_it_can_be_changed_on_the_command_line() -> None:
    """`--set nemesis.every=…`, and a nemesis for a scenario that has none."""
    few, many = (load("nemesis", {"nemesis.every": every}) for every in (400, 40))
    assert len(few.event) < len(many.event)
    changes = {"nemesis.faults": ["cut"], "nemesis.every": 30, "nemesis.lasting": 5}
    assert load("numerical", changes).event


@settings(max_examples=examples(40))
@given(
    seed=st.integers(0, 2**64),
    every=st.sampled_from([1, 1.0, 2.5, 40]),
    lasting=st.sampled_from([1, 3, 90]),
    faults=st.sets(st.sampled_from(["kill", "pause", "cut", "set", "partition"]), min_size=1).map(sorted),
    own=st.sampled_from([[], [{"from": 20, "to": 40, "pause": "eve"}, {"at": 60, "cut": "legitimate"}]]),
)
def test_whatever_is_drawn_is_a_scenario(
    seed: int, every: float, lasting: float, faults: list[str], own: list[dict[str, Any]]
) -> None:
    """No fault of a receiver begins before the one before is over, and the events have no mistake."""
    changed = {"set": {"quality": 0.1}} if "set" in faults else {}
    nemesis = {"faults": faults, "every": every, "lasting": lasting, "seed": seed, **changed}
    scenario = right(nemesis, slots=150, event=own)
    for name in scenario.receivers:
        spans = happening(scenario, name)
        for (_, end, _), (start, _, _) in pairwise(spans):
            assert end is None or start > end
    # A single partition may hit no receiver.
    assert scenario.timeline.acts or faults == ["partition"]


@pytest.mark.thorough
def test_the_same_faults_live_and_in_memory(tmp_path: Path) -> None:
    """All kinds, equal digests of every receiver; and again from what the results have kept."""
    changes: dict[str, Any] = {
        "slots": 250,
        "nemesis__from": 10,
        "nemesis__to": 240,
        "nemesis__every": 50,
        "nemesis__seed": 9,
        "expect": [],
    }
    live = run("nemesis", out=tmp_path / "live", trials=3, **changes)
    kinds = {event.kind for event in load(tmp_path / "live").event}
    assert kinds == {"kill", "pause", "cut", "set", "partition"}
    for again in (
        montecarlo("nemesis", trials=3, out=tmp_path / "memory", **changes),
        montecarlo(tmp_path / "live", trials=3, out=tmp_path / "again"),
    ):
        for name, metrics in live.summary["peers"].items():
            assert metrics["digest"] == again.summary["peers"][name]["digest"]
            assert live.summary["links"][name]["lost_by"] == again.summary["links"][name]["lost_by"]
    assert {link["unexplained"] for link in live.summary["links"].values()} == {0}
