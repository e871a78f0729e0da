"""When the recorder begins rounds of resending, and which outages it lists: with a clock, and connections in the test's hands."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, NoReturn

import pytest

from evedrop.errors import RunError
from evedrop.live.network.session import READY_SECONDS
from evedrop.live.protocol.brief import Flow
from evedrop.live.protocol.commands import Again, ControlCommand
from evedrop.live.recorder.conductor import Conductor, Stop
from evedrop.live.recorder.recovery import Recovery, patience_of
from evedrop.scenario.progress_events import ProgressEvent
from tests.clock import TestClock, clock_at_start, time_of_a_test
from tests.live.recorder.test_conductor_ending import Network


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The recorder goes by a clock of these tests."""
    with time_of_a_test():
        yield


class Conducted:
    """The part of a conductor and of a steering that a recovery uses, with the connections in the test's hands."""

    hub = "router"
    at: int | None = None
    awaits_belief = False

    def __init__(self) -> None:
        self.lost: dict[str, float] = {}
        self.rounds: list[int] = []
        self.repeated: list[str | int] = []
        """What was said again in rounds: the progress, as a number, and other commands."""
        self.present = dict.fromkeys(("router", "sensor", "smart"), True)
        self.changes: dict[str, Any] = {}
        self.restarts = 0
        """How often the time limit of a hold began again."""
        self.another_router = False
        self.unreached: list[str] = []
        self.clock = clock_at_start()

    @property
    def missing(self) -> list[str]:
        """Those that are lost."""
        return list(self.lost)

    def lose(self, *names: str) -> None:
        """These vanish."""
        self.lost |= dict.fromkeys(names, self.clock.monotonic())

    def fail_cut_off(self, names: Collection[str], patience: float) -> NoReturn:
        """As the conductor of a run."""
        raise RunError(f"{', '.join(names)} cut off for {patience:g} s")

    def wait_longer(self, seconds: float) -> None:
        """Give those that are lost more time."""
        self.lost = {name: at + seconds for name, at in self.lost.items()}

    def router_changed(self) -> bool:
        """As the test says."""
        return self.another_router

    def send_to(self, name: str, command: ControlCommand) -> None:
        """Note the rounds."""
        if name == "sensor" and isinstance(command, Again):
            self.rounds.append(command.slot)

    def start(self) -> None:
        """Note it."""
        self.repeated.append("start")

    def restart_limit(self) -> None:
        """Count it."""
        self.restarts += 1

    def repeat_progress(self) -> None:
        """Note it."""
        self.repeated.append("progress")

    def remind(self) -> None:
        """Note it."""
        self.repeated.append("the operator's commands")


def test_losses_that_overlap_are_one_outage() -> None:
    """One entry for each process that was cut off, from its first loss to when slots are joined again; then another."""
    conducted, events = Conducted(), list[ProgressEvent]()
    recovery = Recovery(
        conducted,  # type: ignore[arg-type]
        conducted,  # type: ignore[arg-type]
        Flow(32, 8, 30.0),
        0.0,
        events.append,
    )
    recovery.poll(10)
    for lost in (
        ("smart",),
        ("smart", "sensor"),
        ("smart",),
    ):  # lost and back three times, and no slot joined meanwhile
        conducted.lose(*lost)
        recovery.poll(10)
        conducted.lost = {}
        recovery.poll(10)
    assert conducted.rounds == [10, 10, 10]
    assert events == []
    recovery.poll(11)
    conducted.lose("router", "sensor", "smart")
    recovery.poll(12)
    conducted.lost, conducted.another_router = {}, True
    recovery.poll(12)
    recovery.poll(13)
    outages = [(outage.process, outage.slot, outage.until) for outage in recovery.outages]
    assert outages == [("smart", 10, 11), ("sensor", 10, 11), ("router", 12, 13)]
    assert events == recovery.outages


@pytest.mark.parametrize(("complete", "until"), [(True, 20), (False, None)])
def test_an_outage_that_is_open_at_the_end_lasts_to_the_last_slot_of_a_complete_run(
    complete: bool, until: int | None
) -> None:
    """A process that has reported all slots holds up nothing; otherwise the run did not go on."""
    conducted = Conducted()
    recovery = recovery_of(conducted, clock_at_start(), 30.0)
    recovery.poll(10)
    conducted.lose("smart")
    recovery.poll(10)
    recovery.poll(20)
    recovery.give_up(20, complete)
    assert [(outage.process, outage.slot, outage.until) for outage in recovery.outages] == [("smart", 10, until)]


@pytest.mark.parametrize(("lost", "told"), [("smart", "smart"), ("router", "recorder")])
@pytest.mark.parametrize("again", [False, True])
def test_an_outage_after_which_the_run_did_not_go_on_is_open(lost: str, told: str, again: bool) -> None:
    """The process returns, but the run fails before it joins another slot. A second loss belongs to the same outage."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 30.0)
    recovery.poll(10)
    conducted.lose(lost)
    recovery.poll(10)
    conducted.lost = {}
    recovery.poll(10)
    if again:
        conducted.lose(lost)
        recovery.poll(10)
    clock.now += 5.0
    recovery.give_up(10)
    recovery.give_up(10)
    outages = [(outage.process, outage.slot, outage.until, outage.seconds) for outage in recovery.outages]
    assert outages == [(told, 10, None, 5.0)]


def recovery_of(conducted: Conducted, clock: TestClock, longest_outage: float, pace: float = 0.0) -> Recovery:
    """With batches of 8 slots."""
    conducted.clock = clock
    return Recovery(
        conducted,  # type: ignore[arg-type]
        conducted,  # type: ignore[arg-type]
        Flow(32, 8, longest_outage),
        pace,
        lambda _: None,
    )


def test_time_in_which_the_recorder_did_not_run_does_not_count() -> None:
    """It could not hear that those who were lost are back."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 3.0)
    recovery.poll(10)
    conducted.lose("smart")
    recovery.poll(10)
    clock.now += 3600.0
    recovery.poll(10)
    assert clock.now - conducted.lost["smart"] == pytest.approx(1.0)


def test_nobody_is_judged_while_the_router_is_missing() -> None:
    """Those lost before it may be back without being seen; it is judged itself, after its own time."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 30.0)
    recovery.poll(10)

    def wait(seconds: int) -> None:
        for _ in range(seconds):
            clock.now += 1.0
            recovery.poll(10)

    conducted.lose("smart")
    wait(20)
    conducted.lose("router", "sensor")
    with pytest.raises(RunError, match=r"^router cut off for 30 s$"):
        wait(100)
    assert clock.now == conducted.lost["router"] + 31.0


@pytest.mark.parametrize("awaits_belief", [False, True])
def test_a_held_run_that_waits_for_a_belief_asks_for_it_again(awaits_belief: bool) -> None:
    """The message may have been lost without a connection, as one that came on a key that it does not name."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 30.0)
    recovery.poll(10)
    conducted.at, conducted.awaits_belief = 10, awaits_belief
    held = clock.now
    while clock.now - held < READY_SECONDS:
        clock.now += 1.0
        recovery.poll(10)
    assert len(conducted.rounds) == (3 if awaits_belief else 0)  # as the answers of two rounds may be lost as well
    assert conducted.restarts == 0  # or a receiver that never sends it would hold the run for ever


def test_a_round_waits_for_processes_that_are_back_and_cannot_be_told_yet() -> None:
    """A token that is back may be faster than the subscription behind it; after some seconds the round begins all the same."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 30.0)
    recovery.poll(10)
    for there_after in (1.0, 9.0):
        conducted.rounds.clear()
        conducted.lose("router", "sensor")
        recovery.poll(10)
        conducted.lost, conducted.unreached = {}, ["router"]
        recovery.poll(10)
        clock.now += there_after
        assert conducted.rounds == []
        if there_after < 2.0:
            recovery.poll(10)
            assert conducted.rounds == []
            conducted.unreached = []
        recovery.poll(10)
        assert conducted.rounds == [10]
        conducted.unreached = []


@pytest.mark.parametrize("done", [0, 10])
def test_a_round_repeats_the_commands_that_may_have_been_lost(done: int) -> None:
    """The start of a run of which nothing is joined yet, what the operator ordered, and how far the recorder is."""
    conducted = Conducted()
    recovery = recovery_of(conducted, clock_at_start(), 30.0)
    if done:
        recovery.poll(done)
    conducted.lose("sensor")
    recovery.poll(done)
    assert conducted.repeated == []
    conducted.lost = {}
    recovery.poll(done)
    assert conducted.restarts == 1
    assert conducted.rounds == [done]
    assert conducted.repeated == [*(() if done else ("start",)), "the operator's commands", "progress"]


@pytest.mark.parametrize(("longest_outage", "pace"), [(1.0, 0.0), (8.0, 0.25), (60.0, 0.0), (60.0, 2.0)])
@pytest.mark.parametrize("lost", [True, False])
@pytest.mark.parametrize("gap", [0.1, 7.0, 40.0])
def test_a_round_that_is_lost_is_repeated_before_a_process_counts_as_silent(
    longest_outage: float, pace: float, lost: bool, gap: float
) -> None:
    """Also in a run whose slots were joined at long intervals before; with three rounds after an outage."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, longest_outage, pace)
    recovery.poll(8)
    clock.now += gap
    recovery.poll(16)
    if lost:
        conducted.lose("router")
        recovery.poll(16)
        conducted.lost = {}
    recovery.poll(16)
    patience, until = patience_of(longest_outage, pace, 8), clock.now
    while clock.now - until < patience:
        clock.now += 0.05
        recovery.poll(16)
    assert len(conducted.rounds) >= (3 if lost else 1)
    assert len(conducted.rounds) <= 6


def test_a_round_that_has_helped_does_not_put_off_the_next_one() -> None:
    """Each round in vain doubles the time until the next one; slots that are joined again let rounds begin as soon as before."""
    conducted, clock = Conducted(), clock_at_start()
    recovery = recovery_of(conducted, clock, 30.0)
    conducted.lose("smart")
    recovery.poll(10)
    conducted.lost = {}
    recovery.poll(10)
    took = []
    for done in (11, 12):
        recovery.poll(done)
        began, wanted = clock.now, len(conducted.rounds) + 2
        while len(conducted.rounds) < wanted:
            clock.now += 0.1
            recovery.poll(done)
        took.append(clock.now - began)
    assert took[1] == pytest.approx(took[0], abs=0.15)


def test_a_process_is_reached_when_its_commands_have_a_reader() -> None:
    """Its token alone is not enough; one that is away is not waited for."""
    network = Network()
    network.unread = {network.keys.control("smart"), network.keys.control("sensor")}
    conductor = Conductor(network, ("legitimate", "smart"), Stop())  # type: ignore[arg-type]
    conductor.assemble()
    assert conductor.unreached == ["sensor", "smart"]
    network.watches["sensor"](False)
    assert conductor.next_message() is None
    assert conductor.unreached == ["smart"]
    network.unread.clear()
    assert conductor.unreached == []
