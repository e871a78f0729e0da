"""The end of a run is told until everybody has heard it, connections that are lost just then included."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from evedrop.live.protocol.commands import EndRun
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import EndReport
from evedrop.live.recorder.conductor import Conductor, Stop
from tests.clock import clock_at_start, time_of_a_test

RUN = "r"
NAMES = ("router", "relay", "sensor", "legitimate", "smart")


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The recorder goes by a clock of these tests."""
    with time_of_a_test():
        yield


class Network:
    """The part of a session that a conductor uses, with processes that do as the test says when they are told something."""

    keys, allowance, patience, router_id = RunKeys(RUN), 2**20, 1.0, "id"

    def __init__(self) -> None:
        self.stop = Stop()
        self.reads: dict[str, Callable[[bytes], None]] = {}
        self.watches: dict[str, Callable[[bool], None]] = {}
        self.told: dict[str, int] = dict.fromkeys(NAMES, 0)
        self.does: dict[str, Callable[[int], None]] = {}
        """Process → what it does when it is told that the run is over, by how often it has been told."""
        self.unread: set[str] = set()
        """Keys without a reader."""

    def subscribe_with(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Remember who reads."""
        self.reads[key] = receive

    def watch(self, name: str, changed: Callable[[bool], None]) -> None:
        """Everybody is there."""
        self.watches[name] = changed
        changed(True)

    def asked(self, key: str, receive: Callable[[Any], None]) -> None:
        """Nobody asks."""

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """What is said to a process reaches it at once."""
        name = key.rpartition("/")[2]

        def put(payload: bytes) -> None:
            assert payload == EndRun().pack()
            self.told[name] += 1
            if name in self.does:
                self.does[name](self.told[name])
            else:
                self.ends(name)

        return put

    def reaches(self, key: str) -> bool:
        """Whether a key has a reader."""
        return key not in self.unread

    def linked(self) -> bool:
        """Always."""
        return True

    def ready(self) -> None:
        """Nobody to wait for."""

    def ends(self, name: str, misdelivered: int = 0) -> None:
        """A process confirms that the run is over, and leaves; routers stay for others to leave."""
        if name == "relay":
            self.watches[name](False)
            return
        self.reads[self.keys.journal if name == "router" else self.keys.telemetry(name)](EndReport(misdelivered).pack())
        if name != "router":
            self.watches[name](False)


@pytest.fixture
def network() -> Network:
    """A network whose processes are all there."""
    return Network()


def ended(network: Network, patience: float = 30.0, *missing: str) -> tuple[Conductor, float]:
    """The conductor of a run that has told its end, and the seconds that this took; missing: processes that are cut off."""
    clock = clock_at_start()
    conductor = Conductor(network, ("legitimate", "smart"), network.stop, relayed=True)  # type: ignore[arg-type]
    conductor.assemble()
    for name in missing:
        network.watches[name](False)
        assert conductor.next_message() is None
    began = clock.now
    conductor.end(patience)
    return conductor, clock.now - began


def test_everybody_is_told_once(network: Network) -> None:
    """A process that confirms the end is not told again, and reports how many messages it dropped."""
    network.does["smart"] = lambda _: network.ends("smart", 3)
    conductor, _ = ended(network)
    assert network.told == dict.fromkeys(NAMES, 1)
    assert conductor.misdelivered == {"router": 0, "sensor": 0, "legitimate": 0, "smart": 3}


def test_a_process_that_loses_its_connection_just_then_is_told_again(network: Network) -> None:
    """It vanishes without a word, comes back, and is told again."""

    def lost(times: int) -> None:
        network.watches["smart"](False)
        if times == 1:
            network.watches["smart"](True)
        else:
            network.reads[network.keys.telemetry("smart")](EndReport(0).pack())

    network.does["smart"] = lost
    ended(network)
    assert network.told["smart"] == 2


def test_a_process_that_vanishes_without_a_word_is_not_waited_for_long(network: Network) -> None:
    """Its last message may have been lost: after a while it has left."""
    network.does["smart"] = lambda _: network.watches["smart"](False)
    conductor, seconds = ended(network)
    assert network.told["smart"] == 1
    assert "smart" not in conductor.misdelivered
    assert 3.0 <= seconds < 4.0


def test_a_process_that_was_never_told_is_waited_for(network: Network) -> None:
    """One that is cut off when the run is over is told as soon as it is back; for as long as the scenario allows."""

    def gone(_: int) -> None:
        network.ends("sensor")
        network.watches["smart"](True)

    network.does["sensor"] = gone
    conductor, _ = ended(network, 30.0, "smart")
    assert network.told["smart"] == 1
    assert "smart" in conductor.misdelivered


def test_nobody_is_waited_for_once_the_recorder_is_told_to_end(network: Network) -> None:
    """The others are told; a launcher kills a recorder that does not begin to write the results."""

    def interrupted(_: int) -> None:
        network.stop.want()
        network.ends("sensor")

    network.does["sensor"] = interrupted
    _, seconds = ended(network, 30.0, "smart")
    assert network.told == dict.fromkeys(NAMES, 1) | {"smart": 0}
    assert seconds < 1.0


@pytest.mark.parametrize("name", ["router", "relay"])
def test_a_router_is_told_until_it_confirms(name: str, network: Network) -> None:
    """A message to a router may be lost with a connection too."""
    network.does[name] = lambda times: network.ends(name) if times == 3 else None
    ended(network)
    assert network.told[name] == 3
