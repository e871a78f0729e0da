"""What the conductor waits for and tells to whom, by a clock that the test hands in; no process is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from evedrop.errors import Interrupted, RunError
from evedrop.live.protocol.commands import Abandon, ProcessStatus, ReportStatus, Start
from evedrop.live.protocol.notices import EndReport, Progress
from evedrop.live.recorder.conductor import Conductor, Stop
from evedrop.names import RECORDER
from tests.clock import TestClock, clock_at_start, time_of_a_test
from tests.live.recorder.test_conductor_ending import Network


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The recorder goes by a clock of these tests."""
    with time_of_a_test():
        yield


class Told(Network):
    """Notes what is sent, to whom, and how many seconds after the start."""

    patience = 30.0

    def __init__(self, *absent: str) -> None:
        super().__init__()
        self.clock = clock_at_start()
        self.absent = absent
        self.sent: list[tuple[str, bytes, float]] = []
        self.opened = False
        self.waits: dict[str, tuple[str, ...]] = {}
        """Process that answers requests → the keys on which it says that it waits."""

    def watch(self, name: str, changed: Callable[[bool], None]) -> None:
        """Everybody is there but those that are not."""
        self.watches[name] = changed
        if name not in self.absent:
            changed(True)

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """Whatever is sent is noted, and requests for a status are answered."""
        name = key.rpartition("/")[2]

        def put(payload: bytes) -> None:
            self.sent.append((name, payload, self.clock.now - 1000.0))
            if payload == ReportStatus().pack() and name in self.waits:
                self.reads[self.keys.telemetry(name)](ProcessStatus(0, self.waits[name]).pack())

        return put

    def ready(self) -> None:
        """The run can begin."""
        self.opened = True


def conducted(network: Told, *, relayed: bool = False, stop: Stop | None = None) -> Conductor:
    """A conductor of a run of two receivers."""
    return Conductor(network, ("legitimate", "smart"), stop or Stop(), relayed)  # type: ignore[arg-type]


def test_a_run_begins_when_all_are_there() -> None:
    """Without any waiting; then the sensor alone is told to begin."""
    network = Told()
    conductor = conducted(network)
    assert conductor.missing == ["router", "sensor", "legitimate", "smart"]
    conductor.assemble()
    assert conductor.missing == []
    assert conductor.present["smart"]
    assert network.opened
    assert network.clock.now == 1000.0
    conductor.start()
    assert network.sent == [("sensor", Start().pack(), 0.0)]
    conductor.report_progress(7)
    conductor.repeat_progress()
    assert network.sent[-2:] == [(RECORDER, Progress(7).pack(), 0.0)] * 2


@pytest.mark.parametrize(
    ("unread", "message"),
    [
        (("smart",), "smart did not appear within 30 s; start it, or look at its log"),
        (("sensor", "smart"), "sensor, smart did not appear within 30 s; start them, or look at their logs"),
        ((), "sensor, smart did not appear within 30 s; start them, or look at their logs"),
    ],
)
def test_who_does_not_appear_is_named_after_the_patience(unread: tuple[str, ...], message: str) -> None:
    """And not before; but not a process that is waiting for another one, unless all that are missing do."""
    network = Told("sensor", "smart")
    network.unread = {network.keys.control(name) for name in unread}
    with pytest.raises(RunError) as raised:
        conducted(network).assemble()
    assert str(raised.value) == message
    assert raised.value.missing == (unread or ("sensor", "smart"))
    assert 30.0 < network.clock.now - 1000.0 < (30.2 if unread else 31.5)
    assert not network.opened


@pytest.mark.parametrize(
    ("waits", "named"),
    [
        ({"legitimate": ("evedrop/r/estimate",)}, ("smart",)),
        ({"legitimate": ("evedrop/r/estimate",), "smart": ()}, ("smart",)),
        ({"legitimate": ("evedrop/r/estimate",), "smart": ("evedrop/r/telemetry/smart",)}, ("legitimate", "smart")),
        ({}, ("legitimate", "smart")),
    ],
)
def test_a_process_that_says_that_it_waits_is_not_named(
    waits: dict[str, tuple[str, ...]], named: tuple[str, ...]
) -> None:
    """Of missing processes that have opened their sessions, one that hangs does not answer, or waits for nobody."""
    network = Told("legitimate", "smart")
    network.waits = waits
    with pytest.raises(RunError) as raised:
        conducted(network).assemble()
    assert raised.value.missing == named
    assert [name for name, message, _ in network.sent if message == ReportStatus().pack()] == ["legitimate", "smart"]
    assert network.clock.now - 1000.0 < 31.5


def test_a_signal_ends_the_waiting_for_processes() -> None:
    """At once."""
    network, stop = Told("smart"), Stop()
    stop.wanted = True
    with pytest.raises(Interrupted):
        conducted(network, stop=stop).assemble()
    assert network.clock.now == 1000.0


def test_a_signal_is_waited_for_as_long_as_is_said() -> None:
    """A launcher that leaves a moment later is an interruption, too; one that leaves after the patience is not."""
    for leaves, interrupted in ((1.5, True), (2.5, False)):
        clock = clock_at_start()

        def gone(clock: TestClock = clock, leaves: float = leaves) -> bool:
            return clock.now >= 1000.0 + leaves

        stop = Stop(gone)
        if interrupted:
            with pytest.raises(Interrupted):
                stop.check(2.0)
            assert clock.now == pytest.approx(1000.0 + leaves, abs=0.1)
        else:
            stop.check(2.0)
            assert clock.now == pytest.approx(1002.0, abs=0.1)


def test_time_without_the_router_counts_for_nobody() -> None:
    """Nobody could be seen; those lost with it connect from its return on, those lost before have as much time as then."""
    network = Told()
    conductor = conducted(network)
    conductor.assemble()
    for seconds, name in ((0.0, "smart"), (10.0, "router"), (0.5, "sensor")):
        network.clock.now += seconds
        network.watches[name](False)
        conductor.next_message()
    assert conductor.lost == {"smart": 1000.0, "router": 1010.0, "sensor": 1010.5}
    network.clock.now += 4.5
    network.watches["router"](True)
    conductor.next_message()
    assert conductor.lost == {"smart": 1005.0, "sensor": 1015.0}
    network.watches["router"](False)
    conductor.next_message()
    conductor.wait_longer(60.0)  # the recorder itself was suspended
    conductor.lost |= {"smart": 1010.0}
    network.watches["router"](True)
    conductor.next_message()
    assert conductor.lost == {"smart": 1010.0, "sensor": 1015.0}


def test_processes_that_come_and_go_are_noted() -> None:
    """The first moment of a loss counts; reports are passed on with the names of their senders."""
    network = Told()
    conductor = conducted(network)
    conductor.assemble()
    network.clock.now += 5.0
    network.watches["smart"](False)
    assert conductor.next_message() is None
    network.clock.now += 2.0
    network.watches["smart"](False)
    assert conductor.next_message() is None
    assert conductor.lost == {"smart": 1005.0}
    assert conductor.missing == ["smart"]
    assert conductor.present == {"router": True, "sensor": True, "legitimate": True, "smart": False}
    conductor.absent.add("smart")
    assert conductor.missing == []
    network.watches["smart"](True)
    report = EndReport(0).pack()
    network.reads[network.keys.telemetry("sensor")](report)
    assert conductor.next_message() is None
    assert conductor.lost == {}
    assert conductor.next_message() == ("sensor", report)
    assert conductor.misdelivered == {}
    assert conductor.next_message() is None


def test_the_routers_are_told_last_that_a_run_is_given_up() -> None:
    """The others have some seconds to leave, while a router may still pass on their messages; the relay comes after it."""
    network = Told()
    conductor = conducted(network, relayed=True)
    conductor.assemble()
    conductor.abandon("a reason")
    order = [(name, round(at)) for name, _, at in network.sent]
    assert order == [("sensor", 0), ("legitimate", 0), ("smart", 0), ("router", 2), ("relay", 4)]
    assert {payload for _, payload, _ in network.sent} == {Abandon("a reason").pack()}
    # Nobody is waited for when everybody has left.
    quick = Told()
    quick.unread = {quick.keys.control(name) for name in ("router", "relay", "sensor", "legitimate", "smart")}
    conducted(quick, relayed=True).abandon("a reason")
    assert [round(at) for *_, at in quick.sent] == [0, 0, 0, 0, 0]


def test_a_command_to_all_reaches_who_reports_and_is_there() -> None:
    """The router, the sensor and the receivers; not a relay, nor a process that is cut off."""
    network = Told()
    conductor = conducted(network, relayed=True)
    conductor.assemble()
    network.watches["smart"](False)
    assert conductor.next_message() is None
    conductor.send_to_all(Start())
    assert [name for name, *_ in network.sent] == ["router", "sensor", "legitimate"]


def test_another_router_is_noticed_once() -> None:
    """The one at the start of the run is not another one."""
    network = Told()
    conductor = conducted(network)
    conductor.assemble()
    assert not conductor.router_changed()
    network.router_id = "another"
    assert conductor.router_changed()
    assert not conductor.router_changed()


def test_who_is_cut_off_for_too_long_is_named() -> None:
    """Unless a signal explains it."""
    with pytest.raises(RunError, match=r"^sensor, smart cut off from the network for 7\.5 s; look at the logs$"):
        conducted(Told(), stop=Stop()).fail_cut_off(["sensor", "smart"], 7.5)
    with pytest.raises(Interrupted):
        conducted(Told(), stop=Stop(lambda: True)).fail_cut_off(["sensor"], 7.5)
