"""The process that a stalled run waits for, and when that ends the run; no clock but the test's own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest

from evedrop.errors import Silence
from evedrop.live.protocol.commands import ProcessStatus
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.recorder.recovery import Stall, patience_of
from evedrop.live.recorder.wait_graph import WaitGraph
from tests.clock import clock_at_start, time_of_a_test

KEYS = RunKeys("r")
WINDOW = 100


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The recorder goes by a clock of these tests."""
    with time_of_a_test():
        yield


def at(slot: int, *waits: str) -> ProcessStatus:
    """Where a process says to be."""
    return ProcessStatus(slot, waits)


SENSOR_WAITS = at(150, KEYS.progress("eve"))
ROUTER_WAITS = at(150, KEYS.uplink)
RUNS = {
    "a receiver that sleeps": (
        {"sensor": 150, "router": 150, "legitimate": 150, "eve": 50},
        {
            "sensor": SENSOR_WAITS,
            "router": ROUTER_WAITS,
            "legitimate": at(150, KEYS.downlink("legitimate")),
            "eve": at(77),
        },
        ["eve"],
    ),
    "a receiver that answers nothing": (
        {"sensor": 150, "router": 150, "legitimate": 150, "eve": 50},
        {"sensor": SENSOR_WAITS, "router": ROUTER_WAITS, "legitimate": at(150, KEYS.downlink("legitimate"))},
        ["eve"],
    ),
    "a receiver that says to wait and reports nothing": (
        {"sensor": 150, "router": 150, "legitimate": 150, "eve": 50},
        {"sensor": SENSOR_WAITS, "router": ROUTER_WAITS, "eve": at(150, KEYS.downlink("eve"))},
        ["eve"],
    ),
    "a receiver that reports and makes no progress known, or a sensor that does not hear of it": (
        {"sensor": 100, "router": 100, "legitimate": 100, "eve": 100},
        {
            "sensor": at(100, KEYS.progress("eve")),
            "router": at(100, KEYS.uplink),
            "legitimate": at(100, KEYS.downlink("legitimate")),
            "eve": at(100, KEYS.downlink("eve")),
        },
        ["sensor", "eve"],
    ),
    "a sensor that sleeps": (
        {"sensor": 100, "router": 100, "legitimate": 100, "eve": 100},
        {
            "sensor": at(110),
            "router": at(110, KEYS.uplink),
            "legitimate": at(110, KEYS.downlink("legitimate")),
            "eve": at(110, KEYS.downlink("eve")),
        },
        ["sensor"],
    ),
    "a router that sleeps": (
        {"sensor": 150, "router": 100, "legitimate": 100, "eve": 100},
        {
            "sensor": at(150, KEYS.progress("eve"), KEYS.progress("legitimate")),
            "router": at(110),
            "legitimate": at(110, KEYS.downlink("legitimate")),
            "eve": at(110, KEYS.downlink("eve")),
        },
        ["router"],
    ),
    "a router that keeps no journal": (
        {"sensor": 150, "router": 50, "legitimate": 150, "eve": 150},
        {"sensor": at(150, KEYS.progress("recorder")), "router": at(150, KEYS.uplink)},
        ["router"],
    ),
    "a controller that sleeps": (
        {"sensor": 64, "router": 64, "legitimate": 64, "eve": 64},
        {
            "sensor": at(70, KEYS.input),
            "router": at(71, KEYS.uplink),
            "legitimate": at(71, KEYS.downlink("legitimate")),
            "eve": at(71, KEYS.downlink("eve")),
            "controller": at(70),
        },
        ["controller"],
    ),
    "a controller that does not take an estimate, or an estimator that did not send it": (
        {"sensor": 64, "router": 64, "legitimate": 64, "eve": 64},
        {
            "sensor": at(70, KEYS.input),
            "router": at(71, KEYS.uplink),
            "legitimate": at(71, KEYS.downlink("legitimate")),
            "eve": at(71, KEYS.downlink("eve")),
            "controller": at(70, KEYS.estimate),
        },
        ["legitimate", "controller"],
    ),
    "a controller that does not take a state; the router keeps deliveries until the end of a batch": (
        {"sensor": 64, "router": 64, "legitimate": 64, "eve": 64},
        {
            "sensor": at(70, KEYS.input),
            "router": at(71, KEYS.uplink),
            "legitimate": at(70, KEYS.downlink("legitimate")),
            "eve": at(70, KEYS.downlink("eve")),
            "controller": at(70, KEYS.state),
        },
        ["sensor", "controller"],
    ),
    "the same, and only the sensor is in the middle of a report": (
        {"sensor": 68, "router": 71, "legitimate": 71, "eve": 71},
        {
            "sensor": at(70, KEYS.input),
            "router": at(71, KEYS.uplink),
            "legitimate": at(71, KEYS.downlink("legitimate")),
            "eve": at(71, KEYS.downlink("eve")),
            "controller": at(70, KEYS.state),
        },
        ["sensor", "controller"],
    ),
    "a controller that does not take the last estimate": (
        {"sensor": 68, "router": 71, "legitimate": 71, "eve": 71},
        {
            "sensor": at(70, KEYS.input),
            "router": at(71, KEYS.uplink),
            "legitimate": at(70, KEYS.control("legitimate")),
            "controller": at(70, KEYS.estimate),
        },
        ["legitimate", "controller"],
    ),
    "a legitimate estimator that acknowledges nothing": (
        {"sensor": 64, "router": 64, "legitimate": 64, "eve": 64},
        {
            "sensor": at(70, KEYS.acknowledgements),
            "router": at(70, KEYS.acknowledged),
            "legitimate": at(70),
            "eve": at(71, KEYS.downlink("eve")),
        },
        ["legitimate"],
    ),
    "a peer that does not know the question is not suspected before one that idles": (
        {"sensor": 100, "router": 100, "legitimate": 100, "eve": 100},
        {"sensor": at(110), "router": at(110, KEYS.uplink), "eve": at(110, KEYS.downlink("eve"))},
        ["sensor"],
    ),
}
"""What happens → the slots by report, the answers, and which processes are silent."""


def test_a_process_is_named_once() -> None:
    """Although another one waits for messages of two of its keys."""
    places = {"sensor": 100, "router": 100, "controller": 99}
    waits = at(100, KEYS.state, KEYS.uplink)
    answers = {"sensor": at(100), "router": ROUTER_WAITS, "controller": waits}
    assert WaitGraph(places, answers, 10).silent() == ["sensor"]


@pytest.mark.parametrize("case", RUNS)
def test_who_is_silent(case: str) -> None:
    """The process at the end of the chain of waiting processes, whichever others are idle."""
    places, answers, silent = RUNS[case]
    if "controller" in answers:
        places = {**places, "controller": 64}
    assert WaitGraph(places, answers, 10, ["controller"]).silent() == silent


@pytest.mark.parametrize(
    ("answers", "silent"),
    [
        ({"router": at(70), "eve": at(70, KEYS.downlink("eve"))}, ["router"]),
        ({"router": at(70, KEYS.uplink), "eve": at(70, KEYS.downlink("eve"))}, ["sensor", "router"]),
        ({"router": at(70, KEYS.control("router")), "eve": at(70, KEYS.downlink("eve"))}, ["router", "eve"]),
        ({"router": at(70, KEYS.control("router")), "eve": at(70)}, ["eve"]),
    ],
)
def test_who_holds_up_a_held_run(answers: dict[str, ProcessStatus], silent: list[str]) -> None:
    """The receiver that does not send its final belief, or the router that did not pass the barrier on."""
    answers = {"sensor": at(70, KEYS.control("sensor")), "legitimate": at(70, KEYS.downlink("legitimate")), **answers}
    assert (
        WaitGraph(dict.fromkeys(["sensor", "router", "legitimate", "eve"], 70), answers, 10, (), ["eve"]).silent()
        == silent
    )


class Run:
    """A run that stands still, watched."""

    def __init__(self, patience: float) -> None:
        self.clock = clock_at_start()
        self.asked = 0
        self.answers: dict[str, ProcessStatus] = {}
        self.places = {"sensor": 60, "router": 60, "eve": 50}
        self.stall = Stall(patience, 10, self.ask, "router")

    def ask(self) -> None:
        """Everybody is asked, and answers."""
        self.asked += 1
        for name, where in self.answers.items():
            self.stall.add_answer(name, where)

    def wait(
        self, seconds: float, done: int = 50, step: float = 0.25, *, held: bool = False, missing: bool = False
    ) -> None:
        """Let time go by."""
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.clock.now += step
            self.stall.poll(done, self.reported, held=held, missing=missing)

    def reported(self) -> Mapping[str, int]:
        """How far everybody is."""
        return self.places


def test_a_silent_process_is_named_after_the_patience_and_not_before() -> None:
    """Seconds of a run in which nothing happens are counted, from its last slot on; then the process is named."""
    run = Run(20.0)
    run.answers = {"eve": at(55)}
    run.wait(3.0)
    run.wait(0.25, done=50)
    run.wait(19.0)
    assert run.asked > 3
    message = r"eve: alive, and silent for 2\d s while the run waits for slot 50 \(eve is at slot 55"
    with pytest.raises(Silence, match=message) as raised:
        run.wait(10.0)
    assert raised.value.at_fault == ("eve",)


def test_all_are_asked_while_a_final_belief_is_awaited_and_nobody_is_silent() -> None:
    """The hold has its own time limit. Before anybody was asked, the late processes are named."""
    run = Run(20.0)
    assert run.stall.held_up_by(["eve"], run.places) == (("eve",), "")
    run.answers = {"router": at(50), "eve": at(50, KEYS.downlink("eve"))}
    for _ in range(400):
        run.clock.now += 0.25
        run.stall.poll(50, run.reported, held=True, missing=False, belief=True)
    assert run.stall.held_up_by(["eve"], run.places) == (("router",), "router is at slot 50 and waits for no process")


@pytest.mark.parametrize("how", ["held", "missing", "asleep", "joined"])
def test_time_in_which_nobody_is_expected_to_do_anything_does_not_count(how: str) -> None:
    """Nothing counts as silent while a run is held or paused, a process is cut off, the machine sleeps, or slots are joined."""
    run = Run(20.0)
    run.answers = {"eve": at(55)}
    run.wait(15.0)
    if how == "asleep":
        run.clock.now += 5000.0
    elif how == "joined":
        run.places["eve"] = 51
        run.wait(0.25, done=51)
    else:
        run.wait(500.0, **{how: True})
    run.wait(5.0, done=run.places["eve"])
    with pytest.raises(Silence):
        run.wait(25.0, done=run.places["eve"])


def test_the_router_is_named_if_nobody_answers() -> None:
    """It is suspended: the questions, or the answers, do not come through."""
    run = Run(20.0)
    with pytest.raises(Silence) as raised:
        run.wait(30.0)
    assert raised.value.at_fault == ("router",)


def test_a_slow_process_is_not_silent() -> None:
    """One that takes longer for a batch than the patience, but goes on from slot to slot, is waited for."""
    run = Run(20.0)
    for slot in range(50, 60):
        run.answers = {"eve": at(slot)}
        run.wait(15.0)


def test_slots_beyond_the_next_report_are_not_assumed() -> None:
    """A process that says again and again that it goes on, but never reports, is silent all the same."""
    run = Run(20.0)
    slot = 50

    def go_on() -> None:
        nonlocal slot
        while True:
            slot += 1
            run.answers = {"eve": at(slot)}
            run.wait(15.0)

    with pytest.raises(Silence):
        go_on()
    assert slot <= 50 + 10 + 3


def test_patience_allows_for_real_time() -> None:
    """The scenario's longest outage, at least some seconds, and two batches in real time."""
    assert patience_of(30.0, 0.0, 256) == 30.0
    assert patience_of(0.0, 0.0, 256) == 5.0
    assert patience_of(30.0, 60.0, 1) == 150.0
