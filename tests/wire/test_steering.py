"""When a wire carries out its events: at their times, by a clock that the test hands in."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.system.waiting import SystemClock
from evedrop.wire.file import wire_of
from evedrop.wire.plan import WirePlan
from evedrop.wire.relay import WireRelay
from evedrop.wire.run import run_wire
from evedrop.wire.steering import WireConductor
from evedrop.wire.timeline import Moment
from tests.clock import TestClock
from tests.conftest import wait_until


class Applied:
    """In place of the wire's links: when they were given which state."""

    def __init__(self, clock: TestClock) -> None:
        self._clock, self._start = clock, clock.now
        self.at: list[tuple[float, frozenset[str], tuple[str, ...]]] = []

    def apply(self, moment: Moment) -> None:
        """Note the seconds since the start, the links that are cut, and the lines."""
        self.at.append((self._clock.now - self._start, moment.cut, moment.lines))


def plan_of(*events: dict[str, Any]) -> WirePlan:
    """A wire of one link with these events."""
    return wire_of({"side": {"robot": {}, "base": {}}, "link": [{"from": "robot", "to": "base"}], "event": [*events]})


CUT, WHOLE = frozenset({"robot-base"}), frozenset[str]()


def test_events_happen_at_their_times() -> None:
    """Not before and not after, each once, in the order of time; the start is the beginning of the `with` block."""
    clock = TestClock()
    links, lines = Applied(clock), list[str]()
    plan = plan_of(
        {"from": 12, "to": 60.5, "cut": "robot-base"}, {"at": 7, "note": "in the lift"}, {"at": 0, "note": "go"},
        {"from": 0.5, "to": 0.75, "cut": "robot-base"},
    )  # fmt: skip
    conductor = WireConductor(plan, links, lines.append, clock)  # type: ignore[arg-type]
    assert [(at, cut) for at, cut, _ in links.at] == [(0.0, WHOLE)]
    assert lines == []
    clock.sleep(100.0)
    with conductor:
        wait_until(lambda: len(links.at) == 7, "all events are carried out")
    assert links.at[1:] == [
        (100.0, WHOLE, ("go",)),
        (100.5, CUT, ("cut robot-base",)),
        (100.75, WHOLE, ("heal robot-base",)),
        (107.0, WHOLE, ("in the lift",)),
        (112.0, CUT, ("cut robot-base",)),
        (160.5, WHOLE, ("heal robot-base",)),
    ]
    assert lines == [
        "0.0 s: go",
        "0.5 s: cut robot-base",
        "0.8 s: heal robot-base",
        "7.0 s: in the lift",
        "12.0 s: cut robot-base",
        "60.5 s: heal robot-base",
    ]
    assert conductor.seconds == 60.5


def test_an_operator_changes_the_wire_at_once() -> None:
    """Its lines say when; what it began lasts until it ends it."""
    clock = TestClock()
    links, lines = Applied(clock), list[str]()
    with WireConductor(plan_of(), links, lines.append, clock) as conductor:  # type: ignore[arg-type]
        wait_until(lambda: len(links.at) == 2, "the wire begins")
        clock.sleep(3.25)
        assert conductor.seconds == 3.25
        assert conductor.change({"cut": "robot-base"}) == "cut robot-base"
        clock.sleep(1.5)
        assert conductor.change({"heal": "robot-base"}) == "heal robot-base"
        clock.sleep(1.0)
        assert conductor.change({"partition": ["robot", "base"]}) == "partition robot, base"
        clock.sleep(1.0)
        assert conductor.change({"join": ["base", "robot"]}) == "heal robot, base"
    assert links.at[2:] == [
        (3.25, CUT, ("cut robot-base",)),
        (4.75, WHOLE, ("heal robot-base",)),
        (5.75, CUT, ("partition robot, base",)),
        (6.75, WHOLE, ("heal robot, base",)),
    ]
    assert lines == [
        "3.2 s: cut robot-base",
        "4.8 s: heal robot-base",
        "5.8 s: partition robot, base",
        "6.8 s: heal robot, base",
    ]
    assert [(event.start, event.stop) for event in conductor._plan.events] == [(3.25, 4.75), (5.75, 6.75)]


def test_an_event_that_is_due_comes_before_what_an_operator_does() -> None:
    """Also if the thread of the events has not come to it: the operator's change is made to what the event made."""
    clock = TestClock()
    links, lines = Applied(clock), list[str]()
    # Without its thread: nobody else looks at the time.
    conductor = WireConductor(plan_of({"at": 2, "cut": "robot-base"}), links, lines.append, clock)  # type: ignore[arg-type]
    clock.sleep(5.0)
    conductor.change({"heal": "robot-base"})
    assert lines == ["2.0 s: cut robot-base", "5.0 s: heal robot-base"]
    assert [(cut, lines) for _, cut, lines in links.at] == [
        (WHOLE, ()),
        (WHOLE, ()),
        (CUT, ("cut robot-base",)),
        (WHOLE, ("heal robot-base",)),
    ]


def test_the_clock_of_a_wire_is_that_of_the_machine() -> None:
    """Unless another one is handed in."""
    before = time.monotonic()
    now = SystemClock().monotonic()
    assert before <= now <= time.monotonic()
    with WireConductor(plan_of(), Applied(TestClock()), print) as conductor:  # type: ignore[arg-type]
        assert 0.0 <= conductor.seconds <= time.monotonic() - before
        wait_until(lambda: conductor.seconds > 0.0, "time passes")


def test_the_state_of_the_start_is_in_force_before_a_side_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programs may be waiting for the side, and their first messages must meet a cut that an event of time 0 makes."""

    def enter(relay: WireRelay) -> None:
        raise UsageError(f"cut: {[name for name, state in relay.links.items() if state.cut]}")

    monkeypatch.setattr(WireRelay, "__enter__", enter)
    with pytest.raises(UsageError, match="cut: \\['robot-base'\\]"):
        run_wire(plan_of({"at": 0, "cut": "robot-base"}), tmp_path / "out")
