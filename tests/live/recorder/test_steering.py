"""What a run does when the scenario and operators hold and steer it, with a conductor that only notes what it is told."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import pytest

from evedrop.errors import RunError
from evedrop.live.network.operator import Answer, Order, read_answer
from evedrop.live.protocol.commands import ControlCommand, Go, Hold, LinkChange
from evedrop.live.protocol.launcher_events import ProcessRequest
from evedrop.live.protocol.requests import REQUESTS
from evedrop.live.recorder import steering
from evedrop.live.recorder.steering import Steering
from evedrop.model.slot.link import Change
from evedrop.scenario.loading import checked
from evedrop.scenario.progress_events import Held, ProgressEvent
from evedrop.scenario.tables import Scenario
from tests.builders import places_of, scalar_tables
from tests.clock import TestClock
from tests.golden.pages import Golden

SLOTS = 100
TABLES = scalar_tables(1.0, 0.01, slots=SLOTS, eavesdroppers={"smart": {"strategy": "smart", "link": {"quality": 0.7}}})


Sent = tuple[str, ControlCommand]
"""A process, and what it is told."""


@dataclass
class Asked:
    """A question as the recorder has it: keeps its answer."""

    payload: bytes = b""
    answers: list[Answer] = field(default_factory=list)

    def answer(self, payload: bytes) -> None:
        """Keep it."""
        self.answers.append(read_answer("key", payload))


@dataclass
class RecordingConductor:
    """A conductor that keeps the messages that it would send, and the processes that are present."""

    absent: set[str] = field(default_factory=set)
    present: defaultdict[str, bool] = field(default_factory=lambda: defaultdict(lambda: True))
    missing: list[str] = field(default_factory=list)
    sent: list[Sent] = field(default_factory=list)

    def send_to(self, name: str, command: ControlCommand) -> None:
        """Keep it."""
        self.sent.append((name, command))

    def told(self) -> list[Sent]:
        """All since the last time."""
        sent, self.sent = self.sent, []
        return sent


class Run:
    """A steered run in a test's hands."""

    def __init__(self, *events: dict[str, Any], paused: bool = False, longest_outage: float = 30.0) -> None:
        self.conductor = RecordingConductor()
        self.saved: list[Scenario] = []
        self.progress: list[ProgressEvent] = []
        scenario = checked({**TABLES, "event": list(events), "longest_outage": longest_outage}, "test")
        self.steering = Steering(
            scenario,
            self.conductor,  # type: ignore[arg-type]
            self.progress.append,
            self.saved.append,
            paused=paused,
        )

    def asks(self, do: str, reported: int = 0, **fields: Any) -> Asked:
        """An operator asks for something after this number of slots was reported."""
        asked = Asked()
        self.steering.take_order(Order(REQUESTS[do](**fields), asked), reported)  # type: ignore[arg-type]
        return asked

    def holds(self, k: int) -> list[Sent]:
        """The sensor holds before slot k, and then everybody has reported; what the others were told."""
        self.conductor.told()
        self.steering.held(k)
        self.steering.carry_on(k - 1, dict)
        assert self.conductor.told() == [], "something was done before everybody had reported"
        self.steering.carry_on(k, dict)
        return self.conductor.told()

    @property
    def events(self) -> list[tuple[int, str, str]]:
        """What was done."""
        return [(event.slot, event.event, event.by) for event in self.steering.events]


SET = {"link": "legitimate", "set": {"quality": 0.2}}
SETTINGS = {"loss": {"model": "bernoulli", "quality": 0.2}}


def go(k: int, until: int | None = None) -> list[Sent]:
    """The messages when the run continues with slot k, perhaps for some slots."""
    return [("router", Go(k)), ("sensor", Go(k, (), until))]


def test_a_change_is_made_between_two_slots() -> None:
    """The sensor is asked to hold; when it does the router is told, the scenario kept, the run let go, and the slot answered."""
    run = Run()
    asked = run.asks("link", event=SET)
    assert run.conductor.told() == [("sensor", Hold())]
    change = LinkChange("legitimate", (Change(17, SETTINGS),))
    assert run.holds(17) == [("router", change), *go(17)]
    assert asked.answers == [Answer(17, "from slot 17 on: link legitimate: quality = 0.2")]
    assert run.events == [(17, "link legitimate: quality = 0.2", "operator")]
    assert [message.model_dump(exclude_none=True)["event"] for message in run.saved] == [[{"at": 17, **SET}]]


def test_what_the_scenario_changes_later_is_told_again() -> None:
    """A later change of the scenario lies over the operator's as it would had both been in the file."""
    later = {"at": 50, "link": "legitimate", "set": {"reorder": 0.5, "delay": {"model": "constant", "value": 1.0}}}
    run = Run(later, {"at": 60, "cut": "smart"})
    run.asks("link", event=SET)
    _, change = run.holds(17)[0]
    both = {**SETTINGS, "reorder": 0.5, "delay": {"model": "constant", "value": 1.0}}
    assert change == LinkChange("legitimate", (Change(17, SETTINGS), Change(50, both)))


def test_two_operators_are_served_in_the_order_they_came() -> None:
    """Both changes are made at one hold, for which the sensor is asked once; the second sees what the first did."""
    run = Run()
    first, second, third = (run.asks("link", event=event) for event in (SET, {"cut": "smart"}, {"cut": "smart"}))
    assert run.conductor.told() == [("sensor", Hold())]
    assert [type(sent) for _, sent in run.holds(8)] == [LinkChange, LinkChange, Go, Go]
    assert first.answers[0].slot == second.answers[0].slot == 8
    assert third.answers[0].refused == ("cut: smart is cut already, from slot 8 on; expected a heal before",)


def test_changes_that_do_not_fit_into_a_message_are_refused() -> None:
    """With all changes of links that operators have changed before: a router drops larger messages."""
    loss = {"model": "trace", "outcomes": "10" * 2**22}
    run = Run(*({"at": k, "link": "legitimate", "set": {"loss": loss}} for k in range(50, 53)))
    first = run.asks("link", event={"link": "legitimate", "set": {"duplicate": 0.5}})
    assert [type(sent) for _, sent in run.holds(7)] == [LinkChange, Go, Go]
    second = run.asks("link", event={"link": "smart", "set": {"loss": loss}})
    assert run.holds(8) == go(8)
    assert first.answers[0].refused == ()
    assert second.answers[0].refused[0].startswith("the changes of legitimate and smart have more than 33554432 bytes")
    assert (len(run.events), len(run.saved)) == (1, 1)


@pytest.mark.parametrize(
    ("event", "places"),
    [
        ({"link": "legitimate", "set": {"quality": 1.2}}, ["set.quality"]),
        ({"heal": "smart"}, ["heal"]),
        ({"cut": "nobody"}, ["cut"]),
        ({"cut": "legitimate"}, ["event.0.cut"]),
        ({"kill": "smart"}, ["kill"]),
        ({"at": 9, "cut": "smart"}, ["at"]),
        ({}, ["event"]),
        (
            {"link": "smart", "set": {"loss": {"model": "gilbert-elliott", "p": 2.0}, "sluts": 1}},
            ["set.sluts", "set.loss.r", "set.loss.p"],
        ),
    ],
    ids=str,
)
def test_mistakes_change_nothing(event: dict[str, Any], places: list[str], golden: Golden) -> None:
    """All mistakes are answered at once, in the words for a scenario's events, and the run goes on as it was."""
    run = Run({"at": 40, "cut": "legitimate"})
    asked = run.asks("link", event=event)
    assert run.holds(5) == go(5)
    refused = asked.answers[0].refused
    assert places_of(refused) == places
    golden("link", refused)
    assert (run.events, run.saved) == ([], [])


@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({"rate": None}, "set: is empty; expected what changes"),
        ({"loss": {"model": "trace", "outcomes": b"101"}}, "set.loss.outcomes: is a bytes; expected a number, a text"),
        ({"loss": {"model": "no\x1b[31m", "quality": 0.5}}, "set.loss.model: is "),
        ({"loss": {"model": {1: 2}}}, "set.loss.model.1: is a name with a control character"),
    ],
    ids=str,
)
def test_values_that_no_file_can_have_are_refused(changes: dict[str, Any], refused: str) -> None:
    """A request may have what a file cannot: it is refused as well, and does not harm the run."""
    run = Run()
    asked = run.asks("link", event={"link": "legitimate", "set": changes})
    assert run.holds(5) == go(5)
    assert asked.answers[0].refused[0].startswith(refused)
    assert (run.events, run.saved) == ([], [])


def test_an_order_during_a_hold_of_the_scenario_waits_for_it() -> None:
    """A kill waits for its receiver's last word; while it is not done nothing else is; then the change is made, at that slot."""
    run = Run({"at": 30, "kill": "smart"})
    assert run.holds(30) == []
    assert run.events == []
    run.steering.left("smart", 30)
    run.steering.carry_on(30, dict)
    assert [type(event) for event in run.progress] == [ProcessRequest]
    asked = run.asks("link", event=SET)
    run.steering.carry_on(30, dict)
    assert run.conductor.told() == []
    assert asked.answers == []
    run.steering.done(1)
    run.conductor.present["smart"] = False
    run.steering.carry_on(30, dict)
    assert [type(sent) for _, sent in run.conductor.told()] == [LinkChange, Go, Go]
    assert asked.answers[0].slot == 30
    assert [event[1] for event in run.events] == ["kill smart", "link legitimate: quality = 0.2"]


def test_a_wish_to_hold_that_meets_one_of_the_scenario_is_done_there() -> None:
    """The hold that was asked for and the scenario's are one; the scenario's event comes first, and nothing is held twice."""
    run = Run({"at": 30, "cut": "smart"})
    asked = run.asks("link", event={"heal": "smart"})
    assert [type(sent) for _, sent in run.holds(30)] == [LinkChange, Go, Go]
    assert asked.answers[0].slot == 30
    assert [event[1] for event in run.events] == ["cut smart", "heal smart"]


def test_a_pause_lasts_until_it_is_ended() -> None:
    """The run stays held; changes are made at once and at that slot; a second pause says that it is held already."""
    run = Run()
    first = run.asks("pause")
    assert run.holds(12) == []
    assert first.answers == [Answer(12, "held before slot 12")]
    second = run.asks("pause")
    changed = run.asks("link", event=SET)
    run.steering.carry_on(12, dict)
    assert [type(sent) for _, sent in run.conductor.told()] == [LinkChange]
    assert second.answers == [Answer(12, "held already, before slot 12")]
    assert changed.answers[0].slot == 12
    resumed = run.asks("resume")
    run.steering.carry_on(12, dict)
    assert run.conductor.told() == go(12)
    assert resumed.answers == [Answer(12, "the run goes on with slot 12")]
    assert [event[1] for event in run.events] == ["pause the run", "link legitimate: quality = 0.2", "resume the run"]
    assert Held(12) in run.progress


def test_a_run_may_begin_paused() -> None:
    """Before slot 0, with the scenario's events of that slot done, until it is resumed or goes on by steps."""
    run = Run({"at": 0, "cut": "smart"}, paused=True)
    assert run.holds(0) == []
    assert (run.steering.paused, run.events) == (True, [(0, "pause the run", "operator"), (0, "cut smart", "scenario")])
    assert Held(0) in run.progress
    stepped = run.asks("step", slots=3)
    run.steering.carry_on(0, dict)
    assert run.conductor.told() == go(0, until=3)
    assert run.holds(3) == []
    assert stepped.answers == [Answer(3, "slots 0 to 2 passed; held before slot 3")]
    run.asks("resume")
    run.steering.carry_on(3, dict)
    assert run.conductor.told() == go(3)


def test_a_run_that_begins_paused_may_be_resumed_before_it_is_held() -> None:
    """The request waits for the hold before slot 0; the operator is not told that the run is not paused."""
    run = Run(paused=True)
    resumed = run.asks("resume")
    assert resumed.answers == []
    assert run.holds(0) == go(0)
    assert resumed.answers == [Answer(0, "the run goes on with slot 0")]
    assert [event[1] for event in run.events] == ["pause the run", "resume the run"]


def test_resuming_a_run_that_goes_on_holds_nothing() -> None:
    """It is answered at once, and is not an event."""
    run = Run()
    assert run.asks("resume", reported=9).answers == [Answer(9, "the run is not paused")]
    assert (run.conductor.told(), run.events) == ([], [])


def test_a_step_lets_slots_pass_and_holds_again() -> None:
    """Its answer comes when they have passed; what holds the run on the way does not end it."""
    run = Run({"at": 14, "cut": "smart"})
    run.asks("pause")
    run.holds(12)
    stepped = run.asks("step", slots=5)
    run.steering.carry_on(12, dict)
    assert run.conductor.told() == go(12, until=17)
    assert run.holds(14) == go(14, until=17)
    changed = run.asks("link", event=SET)
    assert [type(sent) for _, sent in run.holds(15)] == [LinkChange, Go, Go]
    assert changed.answers[0].slot == 15
    assert stepped.answers == []
    assert run.holds(17) == []
    assert stepped.answers == [Answer(17, "slots 12 to 16 passed; held before slot 17")]
    assert run.steering.paused


def test_a_step_of_a_run_that_goes_on_holds_it_first() -> None:
    """The slots are counted from the slot before which it is held."""
    run = Run()
    stepped = run.asks("step", slots=1)
    assert run.conductor.told() == [("sensor", Hold())]
    assert run.holds(20) == go(20, until=21)
    assert run.holds(21) == []
    assert stepped.answers == [Answer(21, "slot 20 passed; held before slot 21")]


def test_a_step_within_a_step_is_refused() -> None:
    """The first goes on to its end."""
    run = Run()
    first = run.asks("step", slots=10)
    run.holds(20)
    second = run.asks("step", slots=3)
    assert run.holds(22) == go(22, until=30)
    assert second.answers[0].refused == ("another step is under way, to slot 29; wait for its end, or pause first",)
    assert run.holds(30) == []
    assert first.answers[0].slot == 30


def test_a_pause_ends_a_step() -> None:
    """The operator of the step is told how far the run came; a hold where the step would have ended is skipped."""
    run = Run()
    stepped = run.asks("step", slots=10)
    run.holds(20)
    run.asks("pause")
    assert run.holds(22) == []
    assert stepped.answers == [Answer(22, "slots 20 to 21 passed; the run was paused before the step was over")]
    run.asks("resume")
    run.steering.carry_on(22, dict)
    assert run.holds(30) == go(30)


def test_a_resume_ends_a_step() -> None:
    """The run goes on past the slot where the step would have ended."""
    run = Run()
    stepped = run.asks("step", slots=10)
    run.holds(20)
    assert run.asks("resume", reported=24).answers[0].slot == 24
    assert stepped.answers == [Answer(24, "slots 20 to 23 passed; the run was resumed before the step was over")]
    assert run.holds(30) == go(30)


def test_a_step_beyond_the_end_ends_with_the_run() -> None:
    """It is answered when the last slot is scored."""
    run = Run()
    stepped = run.asks("step", slots=SLOTS)
    run.holds(90)
    run.steering.answer_open_orders(SLOTS, complete=True)
    assert stepped.answers == [Answer(SLOTS, f"slots 90 to {SLOTS - 1} passed; the run is over")]


@pytest.mark.parametrize(("do", "fields"), [("pause", {}), ("link", {"event": SET}), ("step", {"slots": 2})])
def test_what_comes_after_the_last_slot_is_refused(do: str, fields: dict[str, Any]) -> None:
    """The sensor has sent all slots and does not hold again: the operator is told, and nothing has changed."""
    run = Run()
    asked = run.asks(do, reported=SLOTS - 3, **fields)
    run.steering.answer_open_orders(SLOTS, complete=True)
    assert asked.answers[0].refused == ("the run ended first; nothing was done",)
    assert (run.events, run.saved) == ([], [])


def test_an_interrupt_answers_who_waits() -> None:
    """A step that is not over, and what waits behind it, are refused."""
    run = Run()
    stepped = run.asks("step", slots=50)
    run.holds(20)
    waiting = run.asks("pause")
    run.steering.answer_open_orders(31, complete=False)
    assert stepped.answers[0].refused == ("slots 20 to 30 passed; the run was ended before the step was over",)
    assert len(waiting.answers[0].refused) == 1


def test_a_pause_before_the_last_slot_holds() -> None:
    """One slot is left then, and passes when the run goes on."""
    run = Run()
    run.asks("pause")
    assert run.holds(SLOTS - 1) == []
    run.asks("resume")
    run.steering.carry_on(SLOTS - 1, dict)
    assert run.conductor.told() == go(SLOTS - 1)


def test_what_was_said_is_said_once_more() -> None:
    """After a lost connection: that the sensor is to hold, or that all are to go on; nothing while the run is held."""
    run = Run()
    run.steering.remind()
    assert run.conductor.told() == []
    run.asks("step", slots=9)
    run.conductor.told()
    run.steering.remind()
    assert run.conductor.told() == [("sensor", Hold())]
    run.steering.held(20)
    run.steering.remind()
    assert run.conductor.told() == []
    run.steering.carry_on(20, dict)
    run.conductor.told()
    run.steering.remind()
    assert run.conductor.told() == go(20, until=29)


def test_a_router_that_missed_a_go_hears_it_while_the_sensor_holds_again() -> None:
    """A router that was started again still waits at the hold before, when the sensor has gone on to the next."""
    run = Run()
    run.asks("pause")
    run.holds(12)
    run.asks("resume")
    run.steering.carry_on(12, dict)
    assert run.conductor.told() == go(12)
    run.steering.held(40)
    run.steering.remind()
    assert run.conductor.told() == go(12)


def test_a_hold_that_is_told_once_more_is_one_hold() -> None:
    """The sensor may say twice that it holds; when the run has gone on since, that is nothing new."""
    run = Run()
    run.asks("pause")
    run.holds(12)
    run.steering.held(12)
    run.asks("resume")
    run.steering.carry_on(12, dict)
    assert run.conductor.told() == go(12)
    run.steering.held(12)
    assert run.steering.at is None


def test_a_restarted_router_receives_all_changes() -> None:
    """Links that an operator has changed are listed with all their changes, from the first slot on; others are not listed."""
    run = Run({"at": 5, "link": "legitimate", "set": {"quality": 0.5}}, {"at": 60, "cut": "smart"})
    assert run.steering.changes == {}
    run.holds(5)
    run.asks("link", event=SET)
    run.holds(17)
    first = Change(5, {"loss": {"model": "bernoulli", "quality": 0.5}})
    assert run.steering.changes == {"legitimate": (first, Change(17, SETTINGS))}


@pytest.mark.parametrize(("longest_outage", "patience"), [(1.0, 30.0), (90.0, 90.0)])
def test_a_hold_lasts_as_long_as_an_outage_may(
    monkeypatch: pytest.MonkeyPatch, longest_outage: float, patience: float
) -> None:
    """Time in which a process is missing or the recorder is suspended does not count: nobody reported less for that."""
    clock = TestClock()
    monkeypatch.setattr(steering, "world", lambda: clock)
    run = Run(longest_outage=longest_outage)
    run.steering.held(5)

    def wait(seconds: float, step: float = 0.5) -> None:
        for _ in range(int(seconds / step)):
            clock.now += step
            run.steering.carry_on(4, lambda: {"smart": 4})

    run.conductor.missing = ["smart"]
    wait(200.0)
    run.conductor.missing = []
    wait(100.0, step=50.0)
    wait(patience - 3.0)
    with pytest.raises(RunError, match=f"^{patience:.0f} s after the run was held before slot 5, smart did not report"):
        wait(3.0)


def waits_in_vain(run: Run, clock: TestClock, reported: int, places: dict[str, int]) -> None:
    """Nothing happens for longer than a hold may last."""
    for _ in range(70):
        clock.now += 0.5
        run.steering.carry_on(reported, lambda: places)


@pytest.mark.parametrize(
    ("confirmed", "why"),
    [(True, "not done yet; look at logs/smart.log"), (False, "the launcher has not confirmed that")],
)
def test_a_process_is_blamed_only_for_what_has_happened_to_it(
    monkeypatch: pytest.MonkeyPatch, confirmed: bool, why: str
) -> None:
    """Not if the launcher, which may be suspended, has not killed it."""
    clock = TestClock()
    monkeypatch.setattr(steering, "world", lambda: clock)
    run = Run({"from": 5, "to": 8, "kill": "smart", "state": "prior"})
    run.steering.left("smart", 5)
    run.holds(5)
    if confirmed:
        run.steering.done(1)
    with pytest.raises(RunError, match=f"before slot 5, kill smart: {why}"):
        waits_in_vain(run, clock, 5, {})


@pytest.mark.parametrize(
    ("places", "named"),
    [
        ({"sensor": 5, "router": 5, "smart": 4, "controller": 0}, "smart"),
        ({"sensor": 5, "router": 3, "smart": 3, "controller": 0}, "router"),
    ],
)
def test_nobody_is_blamed_who_need_not_report_or_has_nothing_to_report(
    monkeypatch: pytest.MonkeyPatch, places: dict[str, int], named: str
) -> None:
    """A controller reports whole batches, and receivers what the router passes on to them."""
    clock = TestClock()
    monkeypatch.setattr(steering, "world", lambda: clock)
    run = Run()
    run.steering.held(5)
    with pytest.raises(RunError, match=f"before slot 5, {named} did not report"):
        waits_in_vain(run, clock, 3, places)
