"""The events of a wire in order: cuts, partitions and changes that overlap; and those that an operator adds."""

from __future__ import annotations

import tomllib
from typing import Any

from evedrop.wire.file import resolved_wire, wire_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.timeline import moment_at, moments, with_change, with_cut_ended, with_partition_ended, with_request
from tests.builders import mistakes_of, places_of
from tests.golden.pages import Golden

SIDES: dict[str, Any] = {"robot": {}, "base": {}, "listener": {}}
LINKS = [
    {"name": "scan", "from": "robot", "to": "base", "keys": "scan/**", "quality": 0.9},
    {"from": "robot", "to": "base"},
    {"from": "base", "to": "robot"},
    {"from": "robot", "to": "listener", "tap": True},
]


def plan_of(*events: dict[str, Any]) -> WirePlan:
    """A wire with these events."""
    return wire_of({"side": SIDES, "link": LINKS, "event": list(events)})


def quality(plan: WirePlan, time: float) -> float:
    """That of the link scan at a time."""
    value: float = moment_at(plan, time).settings["scan"]["loss"]["quality"]
    return value


def test_a_wire_without_events() -> None:
    """It has one moment, its start, with the settings of the file."""
    plan = plan_of()
    (moment,) = moments(plan)
    assert (moment.time, moment.lines, moment.cut) == (0.0, (), frozenset())
    assert moment.settings == {link.name: link.settings for link in plan.links}


def test_cuts_and_partitions_overlap() -> None:
    """A link is cut until both have ended; a partition cuts the links between its sides in both directions, and no others."""
    plan = plan_of(
        {"from": 1, "to": 5, "cut": "scan"},
        {"from": 3, "to": 8, "partition": ["base", "robot"]},
        {"from": 4, "to": 5, "note": "the lift"},
        {"at": 8, "cut": "robot-listener"},
    )
    both = frozenset({"scan", "robot-base", "base-robot"})
    assert [(moment.time, moment.cut, moment.lines) for moment in moments(plan)] == [
        (0.0, frozenset(), ()),
        (1.0, {"scan"}, ("cut scan",)),
        (3.0, both, ("partition base, robot",)),
        (4.0, both, ("the lift",)),
        (5.0, both, ("heal scan",)),
        (8.0, {"robot-listener"}, ("heal base, robot", "cut robot-listener")),
    ]


def test_changes_overlap() -> None:
    """They apply in the order in which they began, whatever their order in the file, and end one by one."""
    plan = plan_of(
        {"from": 3, "to": 6, "link": "scan", "set": {"quality": 0.3}},
        {"from": 1, "to": 9, "link": "scan", "set": {"quality": 0.1, "duplicate": 0.5}},
    )
    assert [quality(plan, time) for time in (0, 1, 2.9, 3, 5.9, 6, 9)] == [0.9, 0.1, 0.1, 0.3, 0.3, 0.1, 0.9]
    assert [moment_at(plan, time).settings["scan"].get("duplicate") for time in (0, 5, 9)] == [None, 0.5, None]
    assert moment_at(plan, 3.0).lines == ('link scan: loss = { model = "bernoulli", quality = 0.3 }',)
    assert moment_at(plan, 6.0).lines == ("link scan: loss as before",)
    assert moment_at(plan, 5.0).settings["robot-base"] == plan.named("robot-base").settings


def test_an_operator_adds_events() -> None:
    """They last, on top of those of the file; what the plan then says can be written as a file."""
    plan, message = with_change(plan_of({"from": 1, "to": 9, "partition": ["robot", "base"]}), {"cut": "scan"}, 2.0)
    assert message == "cut scan"
    plan, message = with_change(plan, {"link": "scan", "set": {"quality": 0.2}}, 3.0)
    assert message == 'link scan: loss = { model = "bernoulli", quality = 0.2 }'
    plan, message = with_change(plan, {"link": "scan", "set": {"rate": "1 kB/s"}}, 4.0)
    assert message == "link scan: rate = 1000.0, queue = 256000"
    plan, message = with_change(plan, {"link": "scan", "set": {"queue": 10}}, 5.0)
    assert message == "link scan: queue = 10, rate = 1000.0"
    assert moment_at(plan, 5.0).settings["scan"]["queue"] == 10
    assert quality(plan, 100.0) == 0.2
    assert "scan" in moment_at(plan, 100.0).cut
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan


def test_an_operator_takes_a_delay_away() -> None:
    """As `radio.link("radio", delay=None)` does, since None is the value of an entry that is not given."""
    delay = {"model": "constant", "value": 0.2}
    plan = wire_of({"side": SIDES, "link": [{"name": "radio", "from": "robot", "to": "base", "delay": delay}]})
    plan, message = with_change(plan, {"link": "radio", "set": {"delay": None}}, 2.0)
    assert message == 'link radio: delay = { model = "constant", value = 0.0 }'
    assert moment_at(plan, 2.0).settings["radio"]["delay"] == {**delay, "value": 0.0}
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan


def test_an_operator_ends_cuts() -> None:
    """Those that last; later ones of the file stay. A cut ended at its very beginning leaves nothing."""
    plan = plan_of({"at": 1, "cut": "scan"}, {"from": 2, "to": 9, "cut": "scan"}, {"from": 20, "to": 21, "cut": "scan"})
    healed, message = with_cut_ended(plan, "scan", 4.0)
    assert message == "heal scan"
    assert [("scan" in moment_at(healed, time).cut) for time in (3, 4, 8, 20)] == [True, False, False, True]
    assert moment_at(with_cut_ended(plan, "scan", 1.0)[0], 1.5).cut == frozenset()
    assert wire_of(tomllib.loads(resolved_wire(with_cut_ended(plan, "scan", 1.0)[0])))


def test_an_operator_ends_partitions() -> None:
    """Named in any order; cuts stay."""
    plan = plan_of({"at": 1, "partition": ["robot", "base"]}, {"at": 1, "cut": "scan"})
    healed, message = with_partition_ended(plan, "base", "robot", 4.0)
    assert message == "heal robot, base"
    assert moment_at(healed, 4.0).cut == {"scan"}


def test_what_an_operator_cannot_do(golden: Golden) -> None:
    """The messages are those of a file, in the same two steps, and say what to do."""
    plan = plan_of({"at": 1, "partition": ["robot", "base"]})
    for change, places in (
        ({"link": "scan", "set": {"qualty": 1, "corrupt": 2}}, ["set.qualty", "set.corrupt"]),
        ({"cut": "scna", "partition": ["robot", "bas"]}, ["event"]),
        ({"partition": ["rbot", "bas"]}, ["partition.0", "partition.1"]),
        ({"cut": "scna"}, ["cut"]),
    ):
        mistakes = mistakes_of(with_change, plan, change, 2.0)
        assert places_of(mistakes) == places
        golden("link", mistakes)
    for end, arguments in (
        (with_cut_ended, ("scan", 2.0)),
        (with_cut_ended, ("scan", 0.5)),
        (with_cut_ended, ("scn", 2.0)),
        (with_partition_ended, ("robot", "listener", 2.0)),
        (with_partition_ended, ("robot", "bse", 2.0)),
    ):
        mistakes = mistakes_of(end, plan, *arguments)
        assert places_of(mistakes) == ["heal"]
        golden("heal", mistakes)


def test_the_loss_model_of_correlated_links_cannot_change() -> None:
    """Their losses share random numbers, so that another model is refused, as in a file; that of other links may change."""
    tied = {"name": "back", "from": "base", "to": "robot", "correlation": {"with": "scan", "strength": 0.5}}
    plan = wire_of({"side": SIDES, "link": [*LINKS[:2], tied]})
    other = {"loss": {"model": "pattern", "outcomes": "10"}}
    assert len(mistakes_of(with_change, plan, {"link": "back", "set": other}, 2.0)) == 1
    assert with_change(plan, {"link": "robot-base", "set": other}, 2.0)[1].startswith("link robot-base: loss = ")
    assert with_change(plan, {"link": "back", "set": {"quality": 0.4}}, 2.0)[1].startswith("link back: loss = ")


def test_an_operator_changes_a_wire_that_has_run_for_weeks() -> None:
    """For longer than a file can say when something happens."""
    weeks = 3e6
    plan, message = with_change(plan_of(), {"cut": "scan"}, weeks)
    assert message == "cut scan"
    assert [moment_at(plan, time).cut for time in (weeks - 1.0, weeks)] == [frozenset(), {"scan"}]
    plan, _ = with_change(plan, {"link": "scan", "set": {"quality": 0.25}}, weeks + 1.0)
    assert quality(plan, weeks + 1.0) == 0.25
    plan, _ = with_cut_ended(plan, "scan", weeks + 2.0)
    assert moment_at(plan, weeks + 2.0).cut == frozenset()


def test_an_operators_event_has_no_time_and_one_thing_to_do() -> None:
    """It is done at once: what is to happen later, or two things in one request, are refused rather than done in part."""
    plan = plan_of({"from": 1, "to": 9, "cut": "scan"})
    for event in ({"cut": "back", "at": 50}, {"cut": "back", "from": 3, "to": 4}, {"heal": "scan", "cut": "back"}):
        assert mistakes_of(with_request, plan, event, 2.0), event
    assert with_request(plan, {"heal": "scan"}, 2.0)[1] == "heal scan"
