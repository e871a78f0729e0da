"""Events in a scenario: every mistake at once with its number, and what right ones come to."""

from __future__ import annotations

from typing import Any

import pytest

from evedrop.model.links.loss_model import Fate
from evedrop.model.slot.link import NEVER
from evedrop.scenario.loading import checked
from evedrop.scenario.tables import Scenario
from tests.builders import listener, mistakes_of, places_of, scalar_tables
from tests.golden.pages import Golden


def eventful(*events: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A scenario with these events."""
    eve = listener("smart", 0.9)
    return {**scalar_tables(1.0, 0.1, slots=100, eavesdroppers={"eve": eve}, event=list(events)), **more}


def right(*events: dict[str, Any], **more: Any) -> Scenario:
    """A scenario with which nothing is wrong."""
    return checked(eventful(*events, **more), "file")


WRONG: dict[str, tuple[list[dict[str, Any]], str]] = {
    "beyond the end": ([{"at": 100, "cut": "eve"}], "event.0.at"),
    "ends beyond": ([{"from": 9, "to": 101, "cut": "eve"}], "event.0.to"),
    "before it begins": (
        [{"from": 9, "to": 9, "cut": "eve"}],
        "event.0.to",
    ),
    "no such link": ([{"at": 1, "cut": "mallory"}], "event.0.cut"),
    "no receiver": (
        [{"at": 1, "kill": "router"}],
        "event.0.kill",
    ),
    "two things": (
        [{"at": 1, "cut": "eve", "note": "x"}],
        "event.0.event",
    ),
    "nothing": ([{"at": 1}], "event.0.event"),
    "no time": ([{"cut": "eve"}], "event.0.at"),
    "two times": ([{"at": 1, "from": 2, "to": 3, "cut": "eve"}], "event.0.at"),
    "no end": (
        [{"from": 2, "cut": "eve"}],
        "event.0.to",
    ),
    "end alone": ([{"at": 2, "to": 3, "cut": "eve"}], "event.0.to"),
    "no lasting thing": ([{"from": 2, "to": 3, "note": "x"}], "event.0.from"),
    "set nothing": ([{"at": 1, "link": "eve", "set": {}}], "event.0.set"),
    "set nowhere": (
        [{"at": 1, "set": {"quality": 0.5}}],
        "event.0.link",
    ),
    "set wrongly": (
        [{"at": 1, "link": "eve", "set": {"quality": 2.0}}],
        "event.0.set.quality",
    ),
    "set what is not": ([{"at": 1, "link": "eve", "set": {"colour": 2}}], "event.0.set.colour"),
    "set a model wrongly": (
        [{"at": 1, "link": "eve", "set": {"loss": {"model": "pattern", "outcomes": "12"}}}],
        "event.0.set.loss.outcomes",
    ),
    "heals what is whole": (
        [{"at": 1, "heal": "eve"}],
        "event.0.heal",
    ),
    "restarts who is there": (
        [{"at": 1, "restart": "eve"}],
        "event.0.restart",
    ),
    "killed twice": (
        [{"at": 1, "kill": "eve"}, {"at": 3, "kill": "eve"}],
        "event.1.kill",
    ),
    "cut twice": (
        [{"from": 1, "to": 9, "cut": "eve"}, {"at": 3, "partition": ["eve"]}],
        "event.1.cut",
    ),
    "back and gone at once": (
        [{"from": 1, "to": 5, "kill": "eve"}, {"at": 5, "pause": "eve"}],
        "event.1.pause",
    ),
    "state of nobody": (
        [{"at": 1, "cut": "eve", "state": "last"}],
        "event.0.state",
    ),
    "jams nothing": (
        [{"at": 1, "jam": "acknowledgements"}],
        "event.0.jam",
    ),
    "unknown entry": ([{"at": 1, "cut": "eve", "why": "x"}], "event.0.why"),
    "seconds without length": (
        [{"at": 1, "link": "eve", "set": {"delay": {"model": "constant", "value": 1.0, "unit": "seconds"}}}],
        "event.0.set.delay.unit",
    ),
    "leaves in the same slot": ([{"at": 7, "pause": "eve"}, {"at": 7, "resume": "eve"}], "event.1.resume"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_event_is_named(name: str, golden: Golden) -> None:
    """With its number, what was found and what was expected; exit status 2."""
    events, place = WRONG[name]
    mistakes = mistakes_of(right, *events)
    assert place in places_of(mistakes)
    golden("check", mistakes)


@pytest.mark.parametrize(
    ("event", "mistake"),
    [
        (
            {"at": 5, "kill": "eve", "state": "last"},
            "event.0.state: is given, but this event does not restart the receiver; give it with restart, or from and to",
        ),
        ({"at": 5, "cut": 3}, 'event.0.cut: is 3; expected a receiver, or a list of receivers, such as "legitimate"'),
        ({"at": 5, "heal": ["eve", 3]}, 'event.0.heal: is ["eve", 3]; expected a receiver, or a list of receivers'),
        (
            {"from": 5, "to": 9, "kill": "eve", "state": "first"},
            'event.0.state: is "first"; expected prior or last, such as "last"',
        ),
    ],
)
def test_a_wrong_value_is_told_in_plain_words(event: dict[str, Any], mistake: str) -> None:
    """One mistake for each, of an entry that the file has."""
    (told,) = mistakes_of(right, event)
    assert told.startswith(mistake)


def test_all_wrong_entries_are_named_at_once() -> None:
    """A line for each, of events among other tables; what only other tables show waits until every table is valid."""
    mistakes = mistakes_of(
        right,
        {"at": 100, "cut": "eve"},
        {"at": 1},
        {"at": 1.5, "kill": "eve"},
        legitimate={"link": {"quality": 0.9, "delay": {"model": "constant"}, "reorder": 3.0}, "window": -1},
    )
    starts = (
        "event.1.event",
        "event.2.at",
        "legitimate.link.delay.value",
        "legitimate.link.reorder",
        "legitimate.window",
    )
    assert len(mistakes) == len(starts), mistakes
    assert all(any(line.startswith(start) for line in mistakes) for start in starts), mistakes


def test_all_mistakes_across_tables_are_named_at_once() -> None:
    """Where every table is valid by itself, those of events among others."""
    mistakes = mistakes_of(
        right,
        {"at": 100, "cut": "eve"},
        {"at": 1, "kill": "nobody"},
        legitimate={"link": {"quality": 0.9, "correlation": {"with": "mallory", "strength": 0.5}}},
        record_trials=2,
    )
    starts = ("event.0.at", "event.1.kill", "legitimate.link.correlation.with", "record_trials")
    assert len(mistakes) == len(starts), mistakes
    assert all(any(line.startswith(start) for line in mistakes) for start in starts), mistakes


@pytest.mark.parametrize(
    ("link", "line"),
    [
        (
            {"correlation": {"with": "nobody", "strength": 0.5}},
            'correlation.with: is "nobody"; expected another receiver',
        ),
        ({"correlation": {"with": "eve", "strength": 0.5}}, 'correlation.with: is "eve"; expected another receiver'),
        ({"correlation": {"with": "legitimate", "strength": 1.5}}, "correlation.strength: is 1.5; expected a number"),
        (
            {"delay": {"model": "constant", "value": 1.0, "unit": "days"}},
            'delay.unit: is "days"; expected "slots" or "se',
        ),
        (
            {"delay": {"model": "constant", "value": 1.0, "unit": "seconds"}},
            "delay.unit: is seconds; expected slot_seconds",
        ),
        (
            {"delay": {"model": "constnat", "value": 1.0}},
            'delay.model: is "constnat"; expected constant, normal, pareto or',
        ),
        ({"queue": 5}, "queue: is given without a rate"),
        ({"reorder": 0.5}, "reorder: is given without a delay"),
        ({"rate": 0.0}, "rate: is 0.0"),
    ],
)
def test_a_wrong_link_is_named(link: dict[str, Any], line: str) -> None:
    """With its path."""
    eve = {"eve": {"strategy": "smart", "link": {"quality": 0.9, **link}}}
    mistakes = mistakes_of(right, eavesdroppers=eve)
    assert any(mistake.startswith(f"eavesdroppers.eve.link.{line}") for mistake in mistakes), mistakes


def test_correlation_needs_links_that_lose_alike() -> None:
    """The same model on both, and no correlation of the other's own."""
    bursts = {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}
    tie = {"with": "legitimate", "strength": 0.5}
    (line,) = mistakes_of(
        right, eavesdroppers={"eve": {"strategy": "smart", "link": {"loss": bursts, "correlation": tie}}}
    )
    assert "the loss models differ (bernoulli there and gilbert-elliott here)" in line
    chained = {
        "eve": {"strategy": "smart", "link": {"quality": 0.9, "correlation": tie}},
        "mallory": {"strategy": "smart", "link": {"quality": 0.9, "correlation": {"with": "eve", "strength": 1.0}}},
    }
    (line,) = mistakes_of(right, eavesdroppers=chained)
    assert "is eve, whose own losses are tied to another link's" in line
    to_pool = {"quality": 0.9, "correlation": {"with": "pool", "strength": 0.5}}
    (line,) = mistakes_of(right, eavesdroppers={"pool": POOL}, legitimate={"link": to_pool})
    several = "is pool, which has several links; expected a receiver with a single link"
    assert line == f"legitimate.link.correlation.with: {several}"


@pytest.mark.parametrize(
    ("name", "tie"),
    [
        ("eve", "its losses are tied to those of legitimate"),
        ("legitimate", "the losses of eve are tied to its losses"),
    ],
)
def test_neither_of_two_tied_links_gets_another_loss_model(name: str, tie: str) -> None:
    """By an event, or by a nemesis."""
    correlation = {"correlation": {"with": "legitimate", "strength": 0.5}}
    eve = {"strategy": "smart", "link": {"quality": 0.9, **correlation}}
    bursts = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}}
    event = {"at": 5, "link": name, "set": bursts}
    (line,) = mistakes_of(right, event, eavesdroppers={"eve": eve})
    mistake = f"gives {name} another loss model, but {tie}; expected the same model"
    assert line == f"event.0.set.loss.model: {mistake}"
    nemesis = {"faults": ["set"], "every": 5, "lasting": 5, "set": bursts, "targets": [name]}
    (line,) = mistakes_of(right, nemesis=nemesis, eavesdroppers={"eve": eve})
    assert line == f"nemesis.set.loss.model: {mistake}"
    bursty = {"eavesdroppers": {"eve": {**eve, "link": {**bursts, **correlation}}}}
    event = {"at": 5, "link": name, "set": {"quality": 0.3}}
    assert mistakes_of(right, event, legitimate={"link": bursts}, **bursty) == [f"event.0.set.quality: {mistake}"]


def test_changes_are_checked_on_top_of_earlier_ones() -> None:
    """Until these are undone, in the order of slots, not of the file."""
    late = {"link": "eve", "set": {"delay": {"model": "constant", "value": 1.0}}}
    reorder = {"link": "eve", "set": {"reorder": 0.5}}
    settings = right({"at": 6, **reorder}, {"at": 5, **late}).timeline.changes["eve"][1].settings
    assert settings is not None
    assert settings["delay"]["value"] == 1.0
    assert settings["reorder"] == 0.5
    for events in ([{"at": 5, **reorder}, {"at": 6, **late}], [{"at": 9, **reorder}, {"from": 5, "to": 8, **late}]):
        (line,) = mistakes_of(right, *events)
        assert line.startswith("event.0.set.reorder: is given without a delay")
    some, all_ = ({"link": "pool", "set": entries} for entries in ({"corrupt": 0.5}, {"quality": 0.5}))
    assert right({"at": 5, **all_}, {"at": 6, **some}, eavesdroppers={"pool": POOL})
    several = "pool has several links; expected a quality or a loss, for the one link that replaces them"
    assert mistakes_of(right, {"at": 5, **some}, eavesdroppers={"pool": POOL}) == [f"event.0.set: {several}"]
    nemesis = {"faults": ["set"], "every": 5, "lasting": 5, "set": {"corrupt": 0.5}}
    assert mistakes_of(right, nemesis=nemesis, eavesdroppers={"pool": POOL}) == [f"nemesis.set: {several}"]


def test_a_scheme_that_may_be_silent_gets_no_rate_later_either() -> None:
    """Neither an event nor a nemesis may limit the link."""
    silent = {"encoding": {"scheme": "scheduled", "threshold": 3}, "acknowledgements": {"link": {"quality": 1.0}}}
    tables = {**silent, "eavesdroppers": {"eve": listener("clear-states", 0.9)}}
    why = "rate: is given, but the scheme scheduled may stay silent"
    (line,) = mistakes_of(right, {"at": 5, "link": "eve", "set": {"rate": 0.5}}, **tables)
    assert line.startswith(f"event.0.set.{why}")
    nemesis = {"faults": ["set"], "every": 5, "lasting": 5, "set": {"rate": 0.5}}
    (line,) = mistakes_of(right, nemesis=nemesis, **tables)
    assert line.startswith(f"nemesis.set.{why}")


def test_delays_in_seconds_are_bounded_in_slots() -> None:
    """At first, and where they change."""
    delay = {"delay": {"model": "constant", "value": 10.0, "unit": "seconds"}}
    line = "delay.value: in slots, it is 10000000.0; expected a number from 0 to 1000000"
    link = {"quality": 0.9, **delay}
    assert mistakes_of(right, slot_seconds=1e-6, legitimate={"link": link}) == [f"legitimate.link.{line}"]
    event = {"at": 5, "link": "eve", "set": delay}
    assert mistakes_of(right, event, slot_seconds=1e-6) == [f"event.0.set.{line}"]
    assert right(event, slot_seconds=1e-5, legitimate={"link": link})


def test_what_events_come_to() -> None:
    """Changes of links that add up and go back, cuts, outages and holds, in order of slots."""
    scenario = right(
        {"from": 30, "to": 40, "link": ["eve"], "set": {"corrupt": 0.5}},
        {"at": 10, "link": "eve", "set": {"quality": 0.5}},
        {"from": 20, "to": 25, "partition": ["legitimate", "eve"]},
        {"from": 50, "to": 60, "kill": "legitimate", "state": "last"},
        {"at": 70, "kill": "eve"},
        {"at": 80, "restart": "eve"},
        {"at": 90, "pause": "eve"},
        {"at": 5, "note": "here we go"},
    )
    eve = scenario.schedule("eve")
    half, whole = ({"model": "bernoulli", "quality": quality} for quality in (0.5, 0.9))
    assert [(change.at, change.settings, change.cut) for change in eve.changes] == [
        (10, {"loss": half}, None),
        (20, None, True),
        (25, None, False),
        (30, {"loss": half, "corrupt": 0.5}, None),
        (40, {"loss": whole}, None),
    ]
    outages = {
        name: [
            (outage.start, outage.stop, outage.reason, outage.keeps_state) for outage in scenario.timeline.outages[name]
        ]
        for name in scenario.receivers
    }
    assert outages == {
        "legitimate": [(50, 60, Fate.DOWN, True)],
        "eve": [(70, 80, Fate.DOWN, False), (90, NEVER, Fate.PAUSED, True)],
    }
    assert sorted(scenario.timeline.holds) == [5, 10, 20, 25, 30, 40, 50, 60, 70, 80, 90]
    assert scenario.timeline.holds[20][0].text == "cut legitimate, eve"


def test_pooled_links_come_back_when_a_change_ends() -> None:
    """One link replaces them meanwhile."""
    pool = right({"from": 10, "to": 20, "link": "pool", "set": {"quality": 0.5}}, eavesdroppers={"pool": POOL})
    schedule = pool.schedule("pool")
    one, back = schedule.changes
    assert (one.at, one.settings) == (10, {"loss": {"model": "bernoulli", "quality": 0.5}})
    assert (back.at, back.settings) == (20, schedule.settings)
    nemesis = {"faults": ["set"], "every": 20, "lasting": 5, "set": {"quality": 0.5}, "targets": ["pool"]}
    assert right(nemesis=nemesis, eavesdroppers={"pool": POOL}).schedule("pool").changes


def test_a_restart_keeps_the_state_that_it_says() -> None:
    """Whatever else ends in the same slot."""
    killed, cut = {"from": 10, "to": 20, "kill": "eve", "state": "last"}, {"from": 12, "to": 20, "cut": "eve"}
    for events in ((killed, cut), (cut, killed)):
        (away,) = right(*events).timeline.outages["eve"]
        assert away.keeps_state


POOL = {"strategy": "colluding", "reads_as": "smart", "links": [{"quality": 0.6}, {"quality": 0.5}]}
ACKNOWLEDGED: dict[str, Any] = {
    "encoding": {"scheme": "acknowledged"},
    "eavesdroppers": {"eve": {"strategy": "reference", "link": {"quality": 0.9}}},
    "acknowledgements": {"link": {"quality": 0.9}, "attack": "all"},
}


@pytest.mark.parametrize("turn", [1, -1])
def test_one_event_may_begin_where_another_ends(turn: int) -> None:
    """In either order in the file: the end comes first."""

    def both(**event: Any) -> list[dict[str, Any]]:
        return [{"from": 10, "to": 20, **event}, {"from": 20, "to": 30, **event}][::turn]

    assert right(*both(jam="acknowledgements"), **ACKNOWLEDGED).timeline.jams == [(10, 20), (20, 30)]
    cuts = right(*both(cut="eve")).timeline.changes["eve"]
    assert [(change.at, change.cut) for change in cuts] == [(10, True), (20, False), (20, True), (30, False)]
    settings = right(*both(link="eve", set={"corrupt": 0.5})).timeline.changes["eve"]
    assert [(change.at, "corrupt" in (change.settings or {})) for change in settings] == [
        (10, True),
        (20, False),
        (20, True),
        (30, False),
    ]


def test_events_survive_being_written_and_read() -> None:
    """A checked scenario, dumped as tables, is the same scenario."""
    scenario = right({"from": 20, "to": 25, "cut": "eve"}, {"at": 30, "link": "eve", "set": {"quality": 0.5}})
    again = Scenario.model_validate(scenario.model_dump(mode="json"))
    assert again == scenario
    assert again.timeline == scenario.timeline


@pytest.mark.parametrize(
    ("event", "receiver", "more"),
    [
        (
            {"from": 10, "to": 20, "kill": "legitimate"},
            "legitimate",
            {"legitimate": {"link": {"quality": 0.9, "delay": {"model": "constant", "value": 1.0}}, "window": 2}},
        ),
        (
            {"from": 10, "to": 20, "jam": "acknowledgements"},
            "eve",
            ACKNOWLEDGED,
        ),
    ],
)
def test_an_expectation_that_events_leave_without_theory_is_refused(
    event: dict[str, Any], receiver: str, more: dict[str, Any]
) -> None:
    """Metrics that would be null are refused, even where link and strategy by themselves have a theory."""
    metric = f"{receiver}.theoretical_trace_covariance"
    expect = [{"metric": metric, "below": 1.0}]
    (line,) = mistakes_of(right, event, expect=expect, **more)
    why = f"no theory covers {receiver} with these links, attacks and events together"
    assert line == f'expect.0.metric: is "{metric}", but {why}; expected another metric'
    assert right(expect=expect, **more)


@pytest.mark.parametrize(
    ("event", "away"),
    [
        ({"from": 10, "to": 20, "kill": "spy"}, "down (event.0, from slot 10 on)"),
        ({"at": 15, "pause": "spy"}, "paused (event.0, from slot 15 on)"),
        ({"from": 16, "to": 20, "kill": "spy"}, None),
        ({"from": 10, "to": 15, "pause": "spy"}, None),
        ({"from": 10, "to": 20, "kill": "legitimate"}, None),
        ({"from": 10, "to": 20, "cut": "spy"}, None),
    ],
)
def test_who_is_told_a_state_must_be_there(event: dict[str, Any], away: str | None) -> None:
    """A slot in which it is down or paused is a mistake; a cut link is not, because the state does not arrive over it."""
    spy = {"strategy": "replay-informed", "reads_as": "naive", "learns_at": 15, "link": {"quality": 0.8}}
    if away is None:
        assert right(event, eavesdroppers={"spy": spy}).leaks == {"spy": 15}
    else:
        (line,) = mistakes_of(right, event, eavesdroppers={"spy": spy})
        assert line == f"eavesdroppers.spy.learns_at: is 15, when spy is {away}; expected a slot in which it is present"


def test_changes_of_a_link_are_told_in_the_order_of_a_toml_file() -> None:
    """Which has tables behind other entries: a run that is repeated from its files tells the same as that of an operator."""
    loss = {"model": "bernoulli", "quality": 0.5}
    one, other = (
        [act.text for act in right({"at": 1, "link": "eve", "set": changes}).event[0].acts()]
        for changes in ({"loss": loss, "corrupt": 0.2}, {"corrupt": 0.2, "loss": loss})
    )
    assert one == other
