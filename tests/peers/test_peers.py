"""Each peer's program, driven through a session that the test plays: what it refuses, and how far it goes alone."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO, cast

import msgpack
import numpy as np
import pytest

from evedrop.errors import EvedropError, Gap, MalformedMessage
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network.process_session import ReplayBuffer
from evedrop.live.network.reporting import is_due
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.brief import AnyBrief, Brief, Flow, LegitimatePart, ReceiverPart, SensorPart
from evedrop.live.protocol.commands import EndRun, Start
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.notices import Progress
from evedrop.model.digest import Blocks, Digests
from evedrop.model.process import Process
from evedrop.model.receiver import prior
from evedrop.peers.eavesdropper import eavesdrop
from evedrop.peers.legitimate import estimate
from evedrop.peers.receiver_loop import _save
from evedrop.peers.sensor import Window, sense
from tests.builders import listener, part_of, scenario_of
from tests.conftest import LIMIT
from tests.live.in_memory import Stage
from tests.messages import delivered, read_packet

WINDOW, BATCH, SLOTS = 12, 4, 50
EXTENT = telemetry.Extent(SLOTS, 300, 2, 3)
PROCESS = Process(np.array([[1.0, 0.1], [0.0, 1.0]]), 1e-3 * np.eye(2), np.eye(2))
TABLES: dict[str, Any] = {
    "slots": SLOTS,
    "trials": 3,
    "legitimate": {"link": {"quality": 0.8}},
    "eavesdroppers": {
        "naive": listener("naive", 0.8),
        "smart": listener("smart", 0.8),
        "suspicious": listener("suspicious", 0.8, use_state=0.9, use_innovation=0.1),
    },
}
"""Of a small scenario with one eavesdropper of each strategy."""


def briefs(**changes: Any) -> dict[str, AnyBrief]:
    """Briefs with a small window."""
    made = briefs_of(
        scenario_of(PROCESS, **{**TABLES, **changes}),
        endpoints_at("tcp/127.0.0.1:1"),
        RecorderTask(Path("nowhere"), False),
    )
    return {name: replace(brief, flow=Flow(WINDOW, BATCH)) for name, brief in made.items()}


@pytest.fixture
def stage() -> Iterator[Stage]:
    """A stage in the place of the network."""
    stage = Stage()
    yield stage
    stage.commands.put(EndRun().pack())


def deliveries(count: int = SLOTS) -> list[bytes]:
    """Deliveries in which trial k mod 3 is lost."""
    made = []
    for k in range(count):
        gamma = np.arange(3) != k % 3
        made.append(delivered(k, gamma, np.full((2, 3), float(k))))
    return made


RECEIVERS: dict[str, Callable[..., None]] = {
    "legitimate": estimate,
    "naive": eavesdrop,
    "smart": eavesdrop,
    "suspicious": eavesdrop,
}


@pytest.mark.parametrize("name", RECEIVERS)
def test_receiver_reports_every_slot_once(name: str, stage: Stage) -> None:
    """A receiver's reports cover all slots without gap, with progress after each batch, and it leaves on `end`."""
    brief = briefs()[name]
    keys = RunKeys(brief.run)
    stage.fill(keys.downlink(name), deliveries())
    stage.commands.put(EndRun().pack())
    RECEIVERS[name](brief, stage.session)
    put = []
    while not stage.put.empty():
        put.append(stage.put.get())
    assert put.pop() == ("closed", b"")
    end = 0
    blocks: dict[int, Digests] = {}
    for key, payload in put:
        if key == keys.telemetry(name):
            report = telemetry.read_report(wire.Reader(key, payload), end, EXTENT, Blocks(SLOTS))
            end, blocks = end + report.slots.count, {**blocks, **report.digests}
            lost = (np.arange(end - report.slots.count, end) % 3)[:, None] == np.arange(3)
            assert np.array_equal(report.slots.action == 0, lost)
        else:
            assert key == keys.progress(name)
            assert Progress.read(key, payload, SLOTS).k == end
    assert end == SLOTS
    assert set(blocks) == {0}


@pytest.mark.parametrize("name", RECEIVERS)
@pytest.mark.parametrize("batch", [1, 100, 256, 300])
def test_reports_do_not_depend_on_the_batch(name: str, batch: int, stage: Stage) -> None:
    """However slots are batched, also across a digest's block, the same estimates and digests are reported."""
    reports = []
    for flow in (Flow(1024, 7), Flow(1024, batch)):
        brief = replace(briefs(slots=600)[name], flow=flow, run="r")
        stage.fill(RunKeys("r").downlink(name), deliveries(600))
        stage.commands.put(EndRun().pack())
        RECEIVERS[name](brief, stage.session)
        end, x_hat, P = 0, [], []
        blocks: dict[int, bytes] = {}
        for payload in stage.all(RunKeys("r").telemetry(name)):
            report = telemetry.read_report(wire.Reader("", payload), end, replace(EXTENT, slots=600), Blocks(600))
            end += report.slots.count
            x_hat.append(report.slots.x_hat)
            P.append(report.slots.P)
            blocks |= {block: digests.tobytes() for block, digests in report.digests.items()}
        reports.append((end, np.concatenate(x_hat).tobytes(), np.concatenate(P).tobytes(), blocks))
    assert reports[0] == reports[1]
    assert set(reports[0][3]) == {0, 256, 512}


def wrong(**fields: bytes | int) -> bytes:
    """A delivery of slot 0 with these fields."""
    return bytes(msgpack.packb({"k": 0, "c": 1, **fields}))


GOOD = deliveries()
BAD: dict[str, tuple[list[bytes], type[EvedropError], str]] = {
    "a slot stays missing": (
        [GOOD[0], GOOD[2], GOOD[3]],
        Gap,
        r"gap on evedrop/.*/downlink/\w+: slot 3 arrived where slot 1",
    ),
    "no msgpack": ([b"\xc1"], MalformedMessage, r"malformed message on evedrop/.*/downlink/\w+: not msgpack"),
    "z too short": ([GOOD[0][:-8]], MalformedMessage, "not msgpack"),
    "mask too long": ([wrong(gamma=b"\1\0")], MalformedMessage, "gamma of 2 bytes; expected 1 bytes"),
    "z missing": ([wrong(gamma=b"\1")], MalformedMessage, "z of None; expected 16 bytes"),
    "z for nobody": ([wrong(gamma=b"\0", z=bytes(16))], MalformedMessage, "z although nothing was received"),
    "not finite": ([wrong(gamma=b"\1", z=np.full(2, np.inf).tobytes())], MalformedMessage, "NaN or infinity"),
    "more slots than a report has": ([wrong(c=BATCH + 1, gamma=bytes(BATCH + 1))], MalformedMessage, "c = 5; expected"),
    "slot as text": ([msgpack.packb({"k": "0", "gamma": b"\0"})], MalformedMessage, "k = '0'"),
    "slot as truth": ([msgpack.packb({"k": False, "gamma": b"\0"})], MalformedMessage, "k = False"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("name", ["legitimate", "suspicious"])
def test_receiver_refuses(case: str, name: str, stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap that is not closed, or a malformed delivery, ends a receiver with an error that names the key and what was due."""
    monkeypatch.setattr("evedrop.live.network.process_session._LEAST_GAP", 0.0)
    messages, error, text = BAD[case]
    brief = replace(briefs()[name], flow=Flow(WINDOW, BATCH, longest_outage=0.0))
    stage.fill(RunKeys(brief.run).downlink(name), messages)
    with pytest.raises(error, match=text) as caught:
        RECEIVERS[name](brief, stage.session)
    assert caught.value.exit_status == 3


def test_who_is_to_be_told_a_state_is_told_it(stage: Stage) -> None:
    """Else the delivery is malformed, which its sender is to blame for."""
    told = {"told": listener("replay-informed", 0.8, learns_at=2, reads_as="smart")}
    brief = briefs(eavesdroppers=told)["told"]
    stage.fill(RunKeys(brief.run).downlink("told"), deliveries())
    with pytest.raises(MalformedMessage, match="no truth; expected truth, the state of slot 2, which is betrayed"):
        RECEIVERS["smart"](brief, stage.session)


@pytest.mark.parametrize("name", ["legitimate", "smart"])
def test_receiver_takes_each_slot_once(name: str, stage: Stage) -> None:
    """Slots that arrive again, barriers too, and slots before the one that is due do not change its reports."""
    brief = replace(briefs()[name], run="r")
    taken = []
    good = deliveries()
    for messages in (
        good,
        [*good[:20], *good[23:30], packets.barrier(25), *good[5:40], packets.barrier(7), good[0], *good[30:]],
    ):
        stage.fill(RunKeys("r").downlink(name), messages)
        stage.commands.put(EndRun().pack())
        RECEIVERS[name](brief, stage.session)
        taken.append(stage.all(RunKeys("r").telemetry(name)))
    assert taken[0] == taken[1]


def test_what_was_acknowledged_is_acknowledged_once_more(stage: Stage) -> None:
    """A delivery that the legitimate estimator has had already may have come because its acknowledgement was lost."""
    brief = replace(
        briefs(
            encoding={"scheme": "acknowledged"},
            acknowledgements={"link": {"quality": 1.0}},
            eavesdroppers={},
            process={
                "A": [[1.0, 0.0], [0.0, 1.0]],
                "Q": [[1.0, 0.0], [0.0, 1.0]],
                "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
            },
        )["legitimate"],
        run="r",
    )

    def with_header(k: int) -> bytes:
        return delivered(k, np.arange(3) != k % 3, np.zeros((2, 3)), header=np.full((1, 3), -1))

    slots = [0, 1, 2, 0, 1, 2, *range(3, SLOTS)]
    stage.fill(RunKeys("r").downlink("legitimate"), [with_header(k) for k in slots])
    stage.commands.put(EndRun().pack())
    part_of(brief, LegitimatePart)
    RECEIVERS["legitimate"](brief, stage.session)
    expected = [packets.acknowledgement(k, np.arange(3) != k % 3) for k in slots]
    assert stage.all(RunKeys("r").acknowledged) == expected


@pytest.mark.parametrize("name", ["legitimate", "smart"])
def test_a_report_is_kept_for_a_window(name: str, stage: Stage) -> None:
    """Reports that the recorder may not have joined yet can be sent again, and no older ones; the last progress too."""
    brief = replace(briefs()[name], run="r")
    stage.fill(RunKeys("r").downlink(name), deliveries())
    stage.commands.put(EndRun().pack())
    RECEIVERS[name](brief, stage.session)
    stage.all("")
    stage.buffers[RunKeys("r").telemetry(name)].again(1, 0)
    ends = []
    for payload in stage.all(RunKeys("r").telemetry(name)):
        message = wire.Reader("", payload)
        ends.append(message.integer("k") + message.integer("c"))
    assert ends == [40, 44, 48, 50]
    stage.buffers[RunKeys("r").progress(name)].again(1, SLOTS)
    assert stage.all(RunKeys("r").progress(name)) == [Progress(SLOTS).pack()]


class SensorThread:
    """A sensor in a thread of its own."""

    def __init__(self, stage: Stage, brief: AnyBrief) -> None:
        self.stage = stage
        self.keys = RunKeys(brief.run)
        self.thread = threading.Thread(target=sense, args=(brief, stage.session), daemon=True)
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
            read_packet(wire.Reader(key, payload), k, (2, 3))
            if (k + 1) % BATCH == 0 or k + 1 == SLOTS:
                key, payload = self.next()
                assert key == self.keys.telemetry("sensor")
                told += telemetry.read_truth(wire.Reader(key, payload), told, EXTENT).count
                assert told == k + 1

    def progress(self, name: str, k: int) -> None:
        """Somebody reports progress."""
        self.stage.callbacks[self.keys.progress(name)](Progress(k).pack())


def test_sensor_sends_as_its_followers_let_it(stage: Stage) -> None:
    """It waits for `start`, sends a window, then what the slowest of receivers and recorder lets it, and ends on `end`."""
    brief = briefs()["sensor"]
    sensor = SensorThread(stage, brief)
    assert stage.put.empty()
    stage.commands.put(Start().pack())
    sensor.packets(0, WINDOW)
    everybody = [*part_of(brief, SensorPart).receivers, "recorder"]
    assert len(everybody) == 5
    sent = WINDOW
    for done in (
        4,
        8,
        20,
        32,
        40,
    ):  # the recorder alone is behind: each of its reports lets exactly as many slots through
        for name in everybody[:-1]:
            sensor.progress(name, sent)
        sensor.progress("recorder", done)
        sensor.packets(sent, sent := min(SLOTS, done + WINDOW))
    stage.commands.put(EndRun().pack())
    sensor.thread.join(LIMIT)
    assert stage.put.get(timeout=LIMIT) == ("closed", b"")
    assert stage.put.empty()


@pytest.mark.parametrize("message", [2, 3, 64])
def test_a_message_of_many_slots_stays_in_the_window(message: int, stage: Stage) -> None:
    """Until its followers report progress, the sensor sends a window, in messages that end with a report."""
    brief = replace(briefs()["sensor"], flow=Flow(WINDOW, BATCH, message=message))
    sensor = SensorThread(stage, brief)
    stage.commands.put(Start().pack())
    sent = 0
    while sent < WINDOW:
        key, payload = sensor.next()
        if key == sensor.keys.uplink:
            made = packets.read_uplink(wire.Reader(key, payload), sent, packets.packet_format(2, 3), BATCH)
            assert made.count == min(message, BATCH - sent % BATCH, WINDOW - sent)
            sent += made.count
    assert sensor.next()[0] == sensor.keys.telemetry("sensor")
    for name in (*part_of(brief, SensorPart).receivers, "recorder"):
        sensor.progress(name, 1)
    made = packets.read_uplink(wire.Reader(*sensor.next()), WINDOW, packets.packet_format(2, 3), BATCH)
    assert made.count == 1


def test_sensor_sends_once_more_what_is_not_done(stage: Stage) -> None:
    """All packets from the slot that is asked for on, and as many before it as the router needs, after a word of them."""
    brief = briefs()["sensor"]
    brief = replace(brief, part=replace(part_of(brief, SensorPart), history=3))
    sensor = SensorThread(stage, brief)
    stage.commands.put(Start().pack())
    sensor.packets(0, WINDOW)
    for name in (*part_of(brief, SensorPart).receivers, "recorder"):
        sensor.progress(name, 8)
    sensor.packets(WINDOW, WINDOW + 8)
    stage.buffers[sensor.keys.uplink].again(4, 10)
    key, payload = sensor.next()
    assert (key, payload) == (sensor.keys.uplink, packets.resend(4, 10, 7))
    for k in range(7, WINDOW + 8):
        read_packet(wire.Reader(*sensor.next()), k, (2, 3))
    stage.buffers[sensor.keys.uplink].again(5, 8)
    assert wire.Reader(*sensor.next()).integer("k") == 5
    for k in range(5, WINDOW + 8):
        read_packet(wire.Reader(*sensor.next()), k, (2, 3))
    assert stage.put.empty()


class WouldWaitError(Exception):
    """The sensor would have to wait for a message."""


class Impatient(SimpleQueue[Any]):
    """A queue that says so instead of waiting."""

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """The next item that is there."""
        if self.empty():
            raise WouldWaitError
        return super().get(block, timeout)


@pytest.mark.parametrize("slowest", ["a", "b", "recorder"])
def test_sensor_is_never_a_window_ahead_of_the_slowest(slowest: str, stage: Stage) -> None:
    """It sends slot k exactly if k < window + the lowest progress; no process's progress replaces another's."""
    followers = ("a", "b", "recorder")
    session = stage.session(briefs()["sensor"])
    window = Window(session, followers, 10, ReplayBuffer(print))
    window._mailbox._queue = Impatient()

    def reaches(limit: int) -> None:
        window.wait(limit - 1)
        with pytest.raises(WouldWaitError):
            window.wait(limit)

    def report(name: str, k: int) -> None:
        stage.callbacks[session.keys.progress(name)](Progress(k).pack())

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
    window = Window(session, ("a",), 1, ReplayBuffer(print))
    stage.callbacks[session.keys.progress("a")](msgpack.packb({"k": k}))
    with pytest.raises(MalformedMessage, match=rf"progress/a: k = {k}.*Check that a speaks") as raised:
        window.wait(2)
    assert raised.value.at_fault == ("a",)


@pytest.mark.parametrize("window", range(2, 40))
def test_a_full_window_always_holds_the_end_of_a_batch(window: int) -> None:
    """In every state some report is due within the next window: no two processes can wait for each other."""
    for batch in range(1, window + 1):
        brief = replace(briefs()["sensor"], flow=Flow(window, batch), slots=101)
        ends = [0, *(k + 1 for k in range(101) if is_due(brief, k))]
        assert ends[-1] == 101
        assert max(np.diff(ends)) <= window


def test_a_belief_that_is_saved_again_is_kept_until_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A receiver that is killed during a second save at the same barrier restarts with the belief of the first."""
    saved = tmp_path / "legitimate.state"
    brief = cast("Brief[ReceiverPart]", briefs()["legitimate"])
    brief = replace(brief, part=replace(brief.part, state_file=str(saved)))
    _save(brief, prior(PROCESS, 3, 0))
    whole = saved.read_bytes()

    def killed(file: BinaryIO, *_: object) -> None:
        file.write(whole[:10])
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", killed)
    with pytest.raises(KeyboardInterrupt):
        _save(brief, prior(PROCESS, 3, 0))
    assert saved.read_bytes() == whole
