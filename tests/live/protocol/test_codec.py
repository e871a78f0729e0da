"""Fields of messages: what each reader takes, and what it refuses with the field, what was found and what was expected."""

from __future__ import annotations

import re
from typing import Any

import msgpack
import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.codec import Reader, pack
from evedrop.live.protocol.notices import Progress, RefusalNotice
from evedrop.live.protocol.packets import packet_format, packets_of, read_delivery, read_uplink, uplink
from evedrop.live.protocol.telemetry import Extent, read_truth, truth
from evedrop.model.receiver import Reception
from evedrop.model.schemes.scheme import PacketBlock
from evedrop.model.slot.link_core import Late
from evedrop.model.slot.records import SensorSlots
from tests.live.protocol.readers import EXAMPLES, READERS, TRIALS, fields_of
from tests.messages import delivered, packet, read_packet

KEY = "evedrop/r1/telemetry/eve"


@pytest.mark.parametrize(("value", "message"), [([1], "a list"), (3, "a int"), (None, "a NoneType"), ("x", "a str")])
def test_a_message_that_is_not_a_map_is_refused(value: object, message: str) -> None:
    """Although it is msgpack."""
    with pytest.raises(MalformedMessage, match=f"{message}; expected a msgpack map"):
        Reader(KEY, msgpack.packb(value))


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("report", {"late": np.full((2, TRIALS), 3, "<u2").tobytes()}, "late of 3; expected numbers from 0 to 2"),
    ("report", {"x_hat": np.full((2, 2, TRIALS), np.nan).tobytes()}, "x_hat with a NaN or infinity; expected finite"),
    (
        "report",
        {"P": np.array([[[1, 0.5], [0.5, 1]], [[1, 0.5], [0.25, 1]]]).tobytes()},
        "P with 0.5 at [1, 0, 1, 0] and 0.25 at [1, 1, 0, 0]; expected covariances, which are symmetric except for rounding",
    ),
    (
        "leaving",
        {"P": np.array([[[1, 1, 1], [0, 0, 0]], [[0, 0, 2], [1, 1, 1]]], float).tobytes()},
        "P with 0.0 at [0, 1, 2] and 2.0 at [1, 0, 2]; expected covariances, which are symmetric except for rounding",
    ),
    ("report", {"digests": {}}, "digests of blocks []; expected those of [0], which end in these slots"),
    ("report", {"digests": {7: b""}}, "digests of block 7; expected of the blocks that end in these slots, [0]"),
    ("report", {"digests": {0: b"short"}}, "digests of block 0; expected 48 bytes a block"),
    ("report", {"k": 4, "c": 1}, "x_hat of 96 bytes; expected 48 bytes"),
    ("delivery", {"gamma": b"\x00"}, "z although nothing was received; expected no z"),
    ("acknowledgement", {"gamma": b"\x08"}, "gamma with a bit beyond trial 2; expected unused bits that are 0"),
]


@pytest.mark.parametrize(("name", "changes", "message"), WRONG)
def test_a_field_that_is_out_of_range_is_refused(name: str, changes: dict[str, Any], message: str) -> None:
    """The rest of the message is right."""
    READERS[name][1](EXAMPLES[name])
    with pytest.raises(MalformedMessage, match=re.escape(f"malformed message on {READERS[name][0]}: {message}")):
        READERS[name][1](pack({**fields_of(name), **changes}))


def test_digests_of_slots_in_which_no_block_ends_are_refused() -> None:
    """The report of one slot in the middle of a block has none."""
    report = fields_of("report")
    fields = {
        name: report[name][: len(report[name]) // 2] for name in ("x_hat", "action", "P", "trace", "late", "late_used")
    }
    key, read = READERS["report"]
    fields |= {"c": 1, "trace_sums": {}}
    read(pack({**report, **fields, "digests": {}}))
    with pytest.raises(
        MalformedMessage, match=f"{key}: digests of block 0; expected none: no block ends in these slots"
    ):
        read(pack({**report, **fields}))


@pytest.mark.parametrize(
    "key", ["evedrop/r2/downlink/eve", "evedrop/r1/downlink/other", "evedrop/r1/nothing", "downlink/eve", ""]
)
def test_only_a_key_that_the_process_reads_can_be_refused(key: str) -> None:
    """Of its own run, and with a writer to blame."""
    right = RefusalNotice.read(Reader(KEY, RefusalNotice.of("evedrop/r1/downlink/eve", "no\nk").pack()), "eve")
    assert right is not None
    assert RefusalNotice.read(Reader(KEY, Progress(3).pack()), "eve") is None
    of_input = Reader("evedrop/r1/telemetry/legitimate", RefusalNotice.of("evedrop/r1/input", "no k").pack())
    refusal = RefusalNotice.read(of_input, "legitimate")  # a legitimate estimator may know the inputs
    assert refusal is not None
    assert refusal.at_fault == ("controller",)
    assert (right.at_fault, "no?k" in str(right)) == (("router",), True)
    with pytest.raises(MalformedMessage, match="expected a key that eve reads"):
        RefusalNotice.read(Reader(KEY, RefusalNotice.of(key, "no k").pack()), "eve")


def test_the_reasons_and_the_alarms_of_the_sensor_are_read_as_sent() -> None:
    """Whether it sent, and whether it raised an alarm; each may be absent."""
    sent, alarms = np.array([[True, False, True]]), np.array([[False, False, True]])
    slots = SensorSlots(4, np.ones((1, 2, 3)), np.zeros((1, 3), np.bool_), sent, alarms)
    result = read_truth(Reader(KEY, truth(slots)), 4, Extent(9, 3, 2, 3))
    assert result.sent is not None
    assert result.alarms is not None
    assert np.array_equal(result.sent, sent)
    assert np.array_equal(result.alarms, alarms)
    assert (result.u, result.failed, result.true) == (None, None, None)
    assert (result.statistic, result.watermark) == (None, None)
    bare = read_truth(Reader(KEY, truth(SensorSlots(4, slots.x, slots.nu))), 4, Extent(9, 3, 2, 3))
    assert (bare.sent, bare.alarms) == (None, None)
    for needed in ({"silent": True}, {"watched": True}):
        with pytest.raises(MalformedMessage, match="sent of None" if "silent" in needed else "alarms of None"):
            read_truth(Reader(KEY, truth(SensorSlots(4, slots.x, slots.nu))), 4, Extent(9, 3, 2, 3, **needed))


def test_statistic_and_watermark_of_a_detector_are_read_as_sent() -> None:
    """Where a run has a detector, both must be there."""
    statistic, watermark = np.array([[0.5, 0.0, 8.5]]), np.array([[[0.1, -0.2, 0.0]]])
    u, failed = np.zeros((1, 1, 3)), np.zeros((1, 3), np.bool_)
    given = (4, np.ones((1, 2, 3)), failed, None, None, u, failed, np.ones((1, 2, 3)))
    extent = Extent(9, 3, 2, 3, inputs=1, measures=True, monitored=True)
    slots = read_truth(Reader(KEY, truth(SensorSlots(*given, statistic, watermark))), 4, extent)
    assert slots.statistic is not None
    assert slots.watermark is not None
    assert np.array_equal(slots.statistic, statistic)
    assert np.array_equal(slots.watermark, watermark)
    with pytest.raises(MalformedMessage, match="statistic"):
        read_truth(Reader(KEY, truth(SensorSlots(*given))), 4, extent)


def test_a_delivery_of_nothing_has_an_empty_header() -> None:
    """The header is 0 where nothing was received, as z is."""
    payload = delivered(4, np.zeros(3, np.bool_), np.ones((2, 3)), header=np.ones((1, 3), np.int64))
    arrivals = read_delivery(Reader(KEY, payload), 4, (2, 3), header=1)
    assert arrivals.header is not None
    assert not arrivals.late
    assert not arrivals.gamma.any()
    assert not arrivals.header.any()
    assert not arrivals.z.any()


def test_infinite_numbers_are_refused_wherever_finite_ones_are_expected() -> None:
    """With the field."""
    for value in (np.inf, -np.inf, np.nan):
        payload = packet(4, np.full((2, 3), value))
        with pytest.raises(MalformedMessage, match="z with a NaN or infinity; expected finite numbers"):
            read_packet(Reader(KEY, payload), 4, (2, 3))


@pytest.mark.parametrize("lists", [20_478, 20_479])
def test_a_large_message_may_have_20480_lists_and_maps(lists: int) -> None:
    """With the message itself, and the list of them; one more is refused, and not only with many more."""
    payload = pack({"room": bytes(70_000), "many": [[]] * lists})
    if lists == 20_478:
        assert len(Reader(KEY, payload).fields["many"]) == lists
        return
    with pytest.raises(MalformedMessage, match="not msgpack"):
        Reader(KEY, payload)


def test_what_a_packet_carries_besides_its_payload_is_read_as_sent() -> None:
    """Header, flags and the state that a receiver learns; a payload that is not sent is 0."""
    z, header, sent = np.arange(1.0, 7.0).reshape(2, 3), np.array([[4, -1, 2**40]]), np.array([True, False, True])
    made = packets_of(4, PacketBlock(z[None], sent[None], header[None], sent[None]), z[None] + 1.0)
    read = read_uplink(Reader(KEY, uplink(made)), 4, packet_format(2, 3, 1))
    given = (np.where(sent, z, 0.0), header, sent, z + 1.0)
    for column, values in zip((read.z, read.header, read.sent, read.truth), given, strict=True):
        assert column is not None
        assert np.array_equal(column[0], values)
    bare = read_uplink(Reader(KEY, packet(4, z)), 4, packet_format(2, 3))
    assert (bare.header, bare.sent, bare.truth) == (None, None, None)


def test_the_header_of_a_delivery_is_read_for_the_trials_that_received() -> None:
    """Of the slot's own packet, and of a late one; 0 elsewhere."""
    header, received = np.array([[4, -1, 2**40]]), np.array([True, False, True])
    late = (Late(3, Reception(~received, np.ones((2, 3)), header)),)
    payload = delivered(4, received, np.ones((2, 3)), late, header)
    heard, late_packets = read_delivery(Reader(KEY, payload), 4, (2, 3), header=1).at(0)
    for reception, gamma in ((heard, received), (late_packets[0].heard, ~received)):
        assert reception.header is not None
        assert np.array_equal(reception.header, np.where(gamma, header, 0))
