"""Each receiver's program, driven through a session that the test plays: what it refuses, and what it reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from evedrop.errors import EvedropError, Gap, MalformedMessage
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.brief import Flow
from evedrop.live.protocol.brief_parts import LegitimatePart
from evedrop.live.protocol.keys import RunKeys
from evedrop.model.digest import Blocks, Digests
from evedrop.model.flag_bits import packed_flags
from evedrop.peers.eavesdropper import eavesdrop
from evedrop.peers.legitimate import estimate
from tests.builders import part_of
from tests.peers.stage import BATCH, EXTENT, SLOTS, WINDOW, Stage, briefs


def deliveries(count: int = SLOTS) -> list[bytes]:
    """Deliveries in which trial k mod 3 is lost."""
    made = []
    for k in range(count):
        gamma = np.arange(3) != k % 3
        made.append(packets.delivery(k, packed_flags(gamma).tobytes(), np.full((2, 2), float(k)).tobytes()))
    return made


RECEIVERS: dict[str, Callable[[Any], None]] = {
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
    stage.commands.put(wire.control("end"))
    RECEIVERS[name](brief)
    put = []
    while not stage.put.empty():
        put.append(stage.put.get())
    assert put.pop() == ("closed", b"")
    end = 0
    blocks: dict[int, Digests] = {}
    for key, payload in put:
        if key == keys.telemetry(name):
            report = telemetry.read_report(wire.Reader(key, payload), end, EXTENT, Blocks(SLOTS))
            end, blocks = end + report.count, {**blocks, **report.digests}
            lost = (np.arange(end - report.count, end) % 3)[:, None] == np.arange(3)
            assert np.array_equal(report.action == 0, lost)
        else:
            assert key == keys.progress(name)
            assert wire.read_progress(key, payload, SLOTS) == end
    assert end == SLOTS
    assert set(blocks) == {0}


@pytest.mark.parametrize("name", RECEIVERS)
@pytest.mark.parametrize("batch", [1, 100, 256, 300])
def test_reports_do_not_depend_on_the_batch(name: str, batch: int, stage: Stage) -> None:
    """However slots are batched, also across a digest's block, the same estimates and digests are reported."""
    found = []
    for flow in (Flow(1024, 7), Flow(1024, batch)):
        brief = replace(briefs(slots=600)[name], flow=flow, run="r")
        stage.fill(RunKeys("r").downlink(name), deliveries(600))
        stage.commands.put(wire.control("end"))
        RECEIVERS[name](brief)
        end, x_hat, P = 0, [], []
        blocks: dict[int, bytes] = {}
        for payload in stage.all(RunKeys("r").telemetry(name)):
            report = telemetry.read_report(wire.Reader("", payload), end, replace(EXTENT, slots=600), Blocks(600))
            end += report.count
            x_hat.append(report.x_hat)
            P.append(report.P)
            blocks |= {block: digests.tobytes() for block, digests in report.digests.items()}
        found.append((end, np.concatenate(x_hat).tobytes(), np.concatenate(P).tobytes(), blocks))
    assert found[0] == found[1]
    assert set(found[0][3]) == {0, 256, 512}


GOOD = deliveries()
BAD: dict[str, tuple[list[bytes], type[EvedropError], str]] = {
    "a slot stays missing": (
        [GOOD[0], GOOD[2], GOOD[3]],
        Gap,
        r"gap on evedrop/.*/downlink/\w+: slot 3 arrived where slot 1",
    ),
    "no msgpack": ([b"\xc1"], MalformedMessage, r"malformed message on evedrop/.*/downlink/\w+: not msgpack"),
    "z too short": ([GOOD[0][:-8]], MalformedMessage, "not msgpack"),
    "mask too long": ([packets.delivery(0, b"\1\0", b"")], MalformedMessage, "gamma of 2 bytes; expected 1 bytes"),
    "z missing": ([packets.delivery(0, b"\1", b"")], MalformedMessage, "z of None; expected 16 bytes"),
    "z for nobody": ([packets.delivery(0, b"\0", bytes(16))], MalformedMessage, "z although nothing was received"),
    "not finite": ([packets.delivery(0, b"\1", np.full(2, np.inf).tobytes())], MalformedMessage, "NaN or infinity"),
    "slot as text": ([msgpack.packb({"k": "0", "gamma": b"\0"})], MalformedMessage, "k = '0'"),
    "slot as truth": ([msgpack.packb({"k": False, "gamma": b"\0"})], MalformedMessage, "k = False"),
}


@pytest.mark.parametrize("what", BAD)
@pytest.mark.parametrize("name", ["legitimate", "suspicious"])
def test_receiver_refuses(what: str, name: str, stage: Stage) -> None:
    """A gap that is not closed, or a malformed delivery, ends a receiver with an error that names the key and what was due."""
    messages, error, text = BAD[what]
    brief = replace(briefs()[name], flow=Flow(WINDOW, BATCH, longest_outage=0.0))
    stage.fill(RunKeys(brief.run).downlink(name), messages)
    with pytest.raises(error, match=text) as caught:
        RECEIVERS[name](brief)
    assert caught.value.exit_status == 3


@pytest.mark.parametrize("name", ["legitimate", "smart"])
def test_receiver_takes_each_slot_once(name: str, stage: Stage) -> None:
    """Slots that arrive again, barriers too, and slots before the one that is due do not change its reports."""
    brief = replace(briefs()[name], run="r")
    found = []
    good = deliveries()
    for messages in (
        good,
        [*good[:20], *good[23:30], packets.barrier(25), *good[5:40], packets.barrier(7), good[0], *good[30:]],
    ):
        stage.fill(RunKeys("r").downlink(name), messages)
        stage.commands.put(wire.control("end"))
        RECEIVERS[name](brief)
        found.append(stage.all(RunKeys("r").telemetry(name)))
    assert found[0] == found[1]


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

    def delivered(k: int) -> bytes:
        gamma = np.arange(3) != k % 3
        header = np.full((1, 2), -1).astype("<i8").tobytes()
        return packets.delivery(k, packed_flags(gamma).tobytes(), bytes(32), header=header)

    slots = [0, 1, 2, 0, 1, 2, *range(3, SLOTS)]
    stage.fill(RunKeys("r").downlink("legitimate"), [delivered(k) for k in slots])
    stage.commands.put(wire.control("end"))
    part_of(brief, LegitimatePart)
    RECEIVERS["legitimate"](brief)
    expected = [packets.acknowledgement(k, np.arange(3) != k % 3) for k in slots]
    assert stage.all(RunKeys("r").acknowledged) == expected


@pytest.mark.parametrize("name", ["legitimate", "smart"])
def test_a_report_is_kept_for_a_window(name: str, stage: Stage) -> None:
    """Reports that the observer may not have joined yet can be sent again, and no older ones; the last progress too."""
    brief = replace(briefs()[name], run="r")
    stage.fill(RunKeys("r").downlink(name), deliveries())
    stage.commands.put(wire.control("end"))
    RECEIVERS[name](brief)
    stage.all("")
    stage.kept[RunKeys("r").telemetry(name)].again(1, 0)
    ends = []
    for payload in stage.all(RunKeys("r").telemetry(name)):
        message = wire.Reader("", payload)
        ends.append(message.integer("k") + message.integer("c"))
    assert ends == [40, 44, 48, 50]
    stage.kept[RunKeys("r").progress(name)].again(1, SLOTS)
    assert stage.all(RunKeys("r").progress(name)) == [wire.progress(SLOTS)]
