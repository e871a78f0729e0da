"""Packets of many slots in one message: read back bit by bit, row for row as in messages of single slots; else refused."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.errors import Gap, MalformedMessage
from evedrop.live.protocol.codec import Reader, pack
from evedrop.live.protocol.keys import writer_of
from evedrop.live.protocol.packets import delivery, packet_format, read_delivery, read_uplink, uplink
from evedrop.live.protocol.record_messages import packed
from evedrop.model.receiver import Reception
from evedrop.model.slot.link_core import NOTHING, Arrivals, Late
from evedrop.model.slot.records import PacketSlots
from tests.examples import examples
from tests.messages import delivered, packet

UP, DOWN = "evedrop/r/uplink", "evedrop/r/downlink/eve"
FIRST, WINDOW, MOST = 7, 3, 6
SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 17))
RANDOM = st.builds(np.random.default_rng, st.integers(0, 2**32))


HEADERS = np.array([0, 3, -1, -(2**63), 2**63 - 1, 0x7FF0000000000001])
"""Also those whose bits are, as a float's, no number: one of them would change where it is taken for one."""


def made_packets(random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool) -> PacketSlots:
    """Packets of some slots; odd: some of them were not sent, and the state is betrayed."""
    n, trials = shape
    c = int(random.integers(1, MOST + 1))
    return PacketSlots(
        FIRST,
        random.normal(size=(c, n, trials)),
        random.choice(HEADERS, (c, header, trials)) if header else None,
        random.random((c, trials)) < 0.5 if odd else None,
        random.normal(size=(c, n, trials)) if odd else None,
    )


def made_arrivals(random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool) -> Arrivals:
    """Arrivals in some slots; odd: with late packets, and a betrayed state."""
    n, trials = shape
    c = int(random.integers(1, MOST + 1))
    gamma = np.array([random.random(trials) < random.choice([0.0, 0.5, 1.0]) for _ in range(c)])
    z = random.normal(size=(c, n, trials))
    headers = random.choice(HEADERS, (c, header, trials)) if header else None
    late = {}
    if odd:
        for row in np.flatnonzero(~gamma.all(axis=1)).tolist():
            heard = Reception(~gamma[row], z[row], None if headers is None else headers[row])
            late[row] = tuple(Late(FIRST + row - back, heard) for back in (2, 1))
    return Arrivals(gamma, z, headers, late, {0: random.normal(size=shape)} if odd and c == 1 else NOTHING)


@settings(deadline=None, max_examples=examples(60))
@given(RANDOM, SHAPES, st.sampled_from([0, 2]), st.booleans())
def test_packets_of_many_slots_are_those_of_each(
    random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool
) -> None:
    """Payloads, headers, what was not sent, and a betrayed state."""
    expect_same_packets(made_packets(random, shape, header, odd), shape, header)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("header", [0, 2])
@pytest.mark.parametrize("odd", [False, True])
def test_packets_of_many_slots_are_those_of_each_in_some_cases(seed: int, header: int, odd: bool) -> None:
    """The same cases in every run of the tests."""
    expect_same_packets(made_packets(np.random.default_rng(seed), (2, 9), header, odd), (2, 9), header)


def expect_same_packets(made: PacketSlots, shape: tuple[int, int], header: int) -> None:
    """A message is read as it was written, and each of its rows as a message of this slot alone."""
    packets = packet_format(*shape, header)
    read = read_uplink(Reader(UP, uplink(made)), FIRST, packets, MOST)
    assert (read.slots, packed(read)) == (made.slots, packed(made))
    for row in range(made.count):
        of_slot = made.rows(slice(row, row + 1))
        alone = read_uplink(Reader(UP, uplink(of_slot)), FIRST + row, packets)
        assert packed(alone) == packed(read.rows(slice(row, row + 1)))


@settings(deadline=None, max_examples=examples(60))
@given(RANDOM, SHAPES, st.sampled_from([0, 2]), st.booleans())
def test_deliveries_of_many_slots_are_those_of_each(
    random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool
) -> None:
    """γ, packets, headers, late packets, and a betrayed state."""
    expect_same_deliveries(made_arrivals(random, shape, header, odd), shape, header)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("header", [0, 2])
@pytest.mark.parametrize("odd", [False, True])
def test_deliveries_of_many_slots_are_those_of_each_in_some_cases(seed: int, header: int, odd: bool) -> None:
    """The same cases in every run of the tests."""
    expect_same_deliveries(made_arrivals(np.random.default_rng(seed), (2, 9), header, odd), (2, 9), header)


def expect_same_deliveries(made: Arrivals, shape: tuple[int, int], header: int) -> None:
    """A message is read as it was written, 0 where nothing was received, and each row as a message of this slot alone."""
    slots = range(FIRST, FIRST + len(made.gamma))
    read = read_delivery(Reader(DOWN, delivery(slots, made)), FIRST, shape, header, WINDOW, MOST)
    for row, k in enumerate(slots):
        (gamma, z, headers, truth), late = made.at(row)
        alone = read_delivery(Reader(DOWN, delivered(k, gamma, z, late, headers, truth)), k, shape, header, WINDOW)
        for arrival in (read.at(row), alone.at(0)):
            expect_same_reception(arrival.heard, Reception(gamma, z, headers, truth))
            assert [packets.k for packets in arrival.late] == [packets.k for packets in late]
            for packets, other in zip(arrival.late, late, strict=True):
                expect_same_reception(packets.heard, other.heard)


def expect_same_reception(heard: Reception, made: Reception) -> None:
    """Bit by bit, where anything was received."""
    assert np.array_equal(heard.gamma, made.gamma)
    assert heard.z.tobytes() == np.where(made.gamma, made.z, 0.0).tobytes()
    for mine, other in ((heard.header, made.header), (heard.truth, made.truth)):
        assert (mine is None) == (other is None)
    if made.header is not None and heard.header is not None:
        assert np.array_equal(heard.header, np.where(made.gamma, made.header, 0))
    if made.truth is not None and heard.truth is not None:
        assert np.array_equal(heard.truth, made.truth)


SPOILT: dict[str, tuple[dict[str, Any], str]] = {
    "another slot": ({"k": 99}, "slot 99 arrived where slot 7 was due"),
    "a slot that is not a number": ({"k": "8"}, "k = '8'"),
    "no slots": ({"c": 0}, "c = 0"),
    "more slots than there may be": ({"c": MOST + 1}, f"c = {MOST + 1}"),
    "slots that are not there": ({"c": 4}, "expected"),
    "NaN in the last slot": ({"z": np.full((3, 2, 3), [[[0.0]], [[0.0]], [[np.nan]]]).tobytes()}, "z with a NaN"),
    "too short": ({"z": bytes(8 * 17)}, "z of 136 bytes; expected 144 bytes"),
    "no bytes": ({"z": [1.0]}, "z of "),
    "no packet": ({"z": None}, "z of None; expected 144 bytes"),
}
SPOILT_DELIVERIES: dict[str, tuple[dict[str, Any], str]] = {
    **SPOILT,
    "a bit beyond the last trial": ({"gamma": b"\x07\xff\x07"}, "gamma with a bit beyond trial 2"),
    "no mask": ({"gamma": None}, "gamma of None; expected 3 bytes"),
    "a mask that is too long": ({"gamma": b"\x07\x07\x07\x00"}, "gamma of 4 bytes; expected 3 bytes"),
    "packets for nobody": ({"gamma": bytes(3)}, "z although nothing was received"),
    "fewer packets than received": ({"gamma": b"\x07\x06\x07"}, "z of 144 bytes; expected 128 bytes"),
    "a late packet in a slot of another message": ({"late": [{"at": 10, "k": 7}]}, "at = 10"),
    "a late packet that is too old": ({"late": [{"at": 9, "k": 5}]}, "a late packet of slot 5; expected one of slot 9"),
    "a late packet of a later slot": ({"late": [{"at": 8, "k": 9}]}, "a late packet of slot 9; expected one of slot 8"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_malformed_packets_are_refused(case: str) -> None:
    """With the key, the writer, the field, and the expected value."""
    changes, message = SPOILT[case]
    fields = {"k": FIRST, "c": 3, "z": np.ones((3, 2, 3)).tobytes(), **changes}
    expect_refused(UP, fields, message, lambda reader: read_uplink(reader, FIRST, packet_format(2, 3), MOST))


@pytest.mark.parametrize("case", SPOILT_DELIVERIES)
def test_malformed_deliveries_are_refused(case: str) -> None:
    """With the key, the writer, the field, and the expected value."""
    changes, message = SPOILT_DELIVERIES[case]
    fields = {"k": FIRST, "c": 3, "gamma": b"\x07\x07\x07", "z": np.ones((3, 2, 3)).tobytes(), **changes}
    expect_refused(DOWN, fields, message, lambda reader: read_delivery(reader, FIRST, (2, 3), 0, WINDOW, MOST))


def expect_refused(key: str, fields: dict[str, Any], message: str, read: Callable[[Reader], object]) -> None:
    """The reader refuses the message in these words."""
    payload = pack({name: value for name, value in fields.items() if value is not None})
    with pytest.raises((MalformedMessage, Gap)) as refused:
        read(Reader(key, payload))
    assert message in str(refused.value)
    assert key in str(refused.value)
    if isinstance(refused.value, MalformedMessage):
        assert refused.value.at_fault == (writer_of(key),)


@settings(deadline=None, max_examples=examples(200))
@given(
    st.binary(max_size=64)
    | st.dictionaries(
        st.sampled_from(["k", "c", "z", "gamma", "header", "sent", "truth", "late", "at"]),
        st.integers(0, 9) | st.binary(max_size=50) | st.lists(st.integers(0, 9), max_size=2) | st.none(),
    ).map(lambda fields: bytes(msgpack.packb(fields)))
)
def test_any_bytes_are_refused_with_key_and_writer(payload: bytes) -> None:
    """Or read, if they are a message: nothing else comes of them."""
    for key, read in (
        (UP, lambda reader: read_uplink(reader, 0, packet_format(1, 2, 1), MOST)),
        (DOWN, lambda reader: read_delivery(reader, 0, (1, 2), 1, WINDOW, MOST)),
    ):
        refused: MalformedMessage | None = None
        try:
            with suppress(Gap):
                read(Reader(key, payload))
        except MalformedMessage as error:
            refused = error
        assert refused is None or (key in str(refused) and refused.at_fault == (writer_of(key),))


def test_the_headers_of_slots_in_which_nothing_arrives_are_0() -> None:
    """The message has no header then, like those of a scheme without one."""
    nothing = pack({"k": FIRST, "c": 3, "gamma": bytes(3)})
    arrivals = read_delivery(Reader(DOWN, nothing), FIRST, (2, 3), 1, most=3)
    assert arrivals.header is not None
    assert np.array_equal(arrivals.header, np.zeros((3, 1, 3)))


def test_headers_and_sent_slots_must_be_there_as_the_scheme_says() -> None:
    """A scheme with a header has one in every message."""
    payload = packet(FIRST, np.ones((2, 3)))
    with pytest.raises(MalformedMessage, match="header of None; expected 24 bytes"):
        read_uplink(Reader(UP, payload), FIRST, packet_format(2, 3, 1))


@pytest.mark.parametrize("gamma", [[[1, 1, 1], [1, 1, 1]], [[1], [0]]], ids=["every trial", "one trial"])
def test_a_delivery_is_read_as_sent_where_it_arrives(gamma: list[list[int]]) -> None:
    """Payloads and headers of two slots: 0 where nothing arrives."""
    flags = np.array(gamma, np.bool_)
    trials = flags.shape[1]
    z, header = np.arange(1.0, 4 * trials + 1).reshape(2, 2, trials), np.arange(1, 2 * trials + 1).reshape(2, 1, trials)
    payload = delivery(range(FIRST, FIRST + 2), Arrivals(flags, z, header))
    read = read_delivery(Reader(DOWN, payload), FIRST, (2, trials), 1, WINDOW, MOST)
    assert read.header is not None
    assert np.array_equal(read.gamma, flags)
    assert np.array_equal(read.z, np.where(flags[:, None], z, 0.0))
    assert np.array_equal(read.header, np.where(flags[:, None], header, 0))
