"""The sensor's program, driven through a session that the test plays: how far it goes alone."""

from __future__ import annotations

import threading
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import msgpack
import numpy as np
import pytest

import evedrop.live.network.mailbox
from evedrop.errors import MalformedMessage
from evedrop.live.network.reporting import is_due
from evedrop.live.network.resending import ReplayBuffer
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.brief import AnyBrief, Flow
from evedrop.live.protocol.brief_parts import SensorPart
from evedrop.live.protocol.keys import RunKeys
from evedrop.peers.sensor import Window, sense
from tests.builders import part_of
from tests.conftest import LIMIT
from tests.peers.stage import BATCH, EXTENT, SLOTS, WINDOW, Stage, briefs


class Sensing:
    """A sensor in a thread of its own."""

    def __init__(self, stage: Stage, brief: AnyBrief) -> None:
        self.stage = stage
        self.keys = RunKeys(brief.run)
        self.thread = threading.Thread(target=sense, args=(brief,), daemon=True)
        self.thread.start()

    def next(self) -> tuple[str, bytes]:
        """What it puts next."""
        return self.stage.put.get(timeout=LIMIT)

    def packets(self, first: int, end: int) -> None:
        """It sends exactly these packets, with its telemetry at the ends of batches, and nothing more."""
        told = first - first % BATCH
        for k in range(first, end):
            key, payload = self.next()
            assert key == self.keys.uplink
            packets.read_uplink(wire.Reader(key, payload), k, (2, 3))
            if (k + 1) % BATCH == 0 or k + 1 == SLOTS:
                key, payload = self.next()
                assert key == self.keys.telemetry("sensor")
                told += telemetry.read_truth(wire.Reader(key, payload), told, EXTENT).count
                assert told == k + 1

    def progress(self, name: str, k: int) -> None:
        """Somebody reports progress."""
        self.stage.funnels[self.keys.progress(name)](wire.progress(k))


def test_sensor_sends_as_its_followers_let_it(stage: Stage) -> None:
    """It waits for `start`, sends a window, then what the slowest of receivers and observer lets it, and ends on `end`."""
    brief = briefs()["sensor"]
    sensing = Sensing(stage, brief)
    assert stage.put.empty()
    stage.commands.put(wire.control("start"))
    sensing.packets(0, WINDOW)
    everybody = [*part_of(brief, SensorPart).receivers, "observer"]
    assert len(everybody) == 5
    sent = WINDOW
    for done in (
        4,
        8,
        20,
        32,
        40,
    ):  # the observer alone is behind: each of its reports lets exactly as many slots through
        for name in everybody[:-1]:
            sensing.progress(name, sent)
        sensing.progress("observer", done)
        sensing.packets(sent, sent := min(SLOTS, done + WINDOW))
    stage.commands.put(wire.control("end"))
    sensing.thread.join(LIMIT)
    assert stage.put.get(timeout=LIMIT) == ("closed", b"")
    assert stage.put.empty()


def test_sensor_sends_once_more_what_is_not_done(stage: Stage) -> None:
    """All packets from the slot that is asked for on, and as many before it as the router needs, after a word of them."""
    brief = briefs()["sensor"]
    brief = replace(brief, part=replace(part_of(brief, SensorPart), history=3))
    sensing = Sensing(stage, brief)
    stage.commands.put(wire.control("start"))
    sensing.packets(0, WINDOW)
    for name in (*part_of(brief, SensorPart).receivers, "observer"):
        sensing.progress(name, 8)
    sensing.packets(WINDOW, WINDOW + 8)
    stage.kept[sensing.keys.uplink].again(4, 10)
    key, payload = sensing.next()
    assert (key, payload) == (sensing.keys.uplink, packets.resend(4, 10, 7))
    for k in range(7, WINDOW + 8):
        packets.read_uplink(wire.Reader(*sensing.next()), k, (2, 3))
    stage.kept[sensing.keys.uplink].again(5, 8)
    assert wire.Reader(*sensing.next()).integer("k") == 5
    for k in range(5, WINDOW + 8):
        packets.read_uplink(wire.Reader(*sensing.next()), k, (2, 3))
    assert stage.put.empty()


class WouldWaitError(Exception):
    """The sensor would have to wait for news."""


class News(SimpleQueue[tuple[str, bytes]]):
    """A queue that says so instead of waiting."""

    def get(self, *_: Any, **__: Any) -> tuple[str, bytes]:
        """The next news that is there."""
        if self.empty():
            raise WouldWaitError
        return super().get()


@pytest.mark.parametrize("slowest", ["a", "b", "observer"])
def test_sensor_is_never_a_window_ahead_of_the_slowest(
    slowest: str, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It sends slot k exactly if k < window + the lowest progress; nobody's progress stands in for another's."""
    monkeypatch.setattr(evedrop.live.network.mailbox, "SimpleQueue", News)
    followers = ("a", "b", "observer")
    session = stage.session(briefs()["sensor"])
    window = Window(session, followers, 10, ReplayBuffer(print))  # type: ignore[arg-type]

    def reaches(limit: int) -> None:
        window.wait(limit - 1)
        with pytest.raises(WouldWaitError):
            window.wait(limit)

    def report(name: str, k: int) -> None:
        stage.funnels[session.keys.progress(name)](wire.progress(k))

    reaches(10)
    for name in set(followers) - {slowest}:
        report(name, 10)
        reaches(10)
    report(slowest, 7)
    reaches(17)
    report(slowest, 3)  # progress never goes back
    reaches(17)
    report(slowest, 17)
    reaches(20)


@pytest.mark.parametrize("k", [1.5, -1, 3, 2**63])
def test_sensor_refuses_malformed_progress(k: float, stage: Stage) -> None:
    """Progress that is not as documented, or beyond what was sent, is an error that names its key and its sender."""
    session = stage.session(briefs()["sensor"])
    window = Window(session, ("a",), 1, ReplayBuffer(print))  # type: ignore[arg-type]
    stage.funnels[session.keys.progress("a")](msgpack.packb({"k": k}))
    with pytest.raises(MalformedMessage, match=rf"progress/a: k = {k}.*Check that a speaks") as found:
        window.wait(2)
    assert found.value.at_fault == ("a",)


@pytest.mark.parametrize("window", range(2, 40))
def test_a_full_window_always_holds_the_end_of_a_batch(window: int) -> None:
    """Whatever has been reported, some report is due within the next window: no two can wait for each other."""
    for batch in range(1, window + 1):
        brief = replace(briefs()["sensor"], flow=Flow(window, batch), slots=101)
        ends = [0, *(k + 1 for k in range(101) if is_due(brief, k))]
        assert ends[-1] == 101
        assert max(np.diff(ends)) <= window
