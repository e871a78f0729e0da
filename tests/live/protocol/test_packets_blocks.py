"""Messages of many slots are read as one by one: the same packets, and the same errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.errors import Gap, MalformedMessage
from evedrop.live.protocol.codec import Reader, pack
from evedrop.live.protocol.packets import (
    delivery,
    packed_header,
    read_deliveries,
    read_delivery,
    read_extras,
    read_uplink,
    read_uplinks,
    uplink,
)
from evedrop.model.receiver import Reception, packed_flags
from evedrop.model.slot.link_core import Late
from tests.examples import examples

UP, DOWN = "evedrop/r/uplink", "evedrop/r/downlink/eve"
FIRST, WINDOW = 7, 3
SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 17))
RANDOM = st.builds(np.random.default_rng, st.integers(0, 2**32))


def uplinks(random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool) -> list[bytes]:
    """Packets of some slots; odd: some of them were not sent in every trial, or betray the state."""
    uplinks = []
    for k in range(FIRST, FIRST + int(random.integers(1, 6))):
        extra = random.integers(0, 5, (header, shape[1])) if header else None
        sent = random.random(shape[1]) < 0.5 if odd and random.random() < 0.5 else None
        truth = random.normal(size=shape) if odd and random.random() < 0.3 else None
        uplinks.append(uplink(k, random.normal(size=shape), extra, sent, truth))
    return uplinks


def deliveries(random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool) -> list[bytes]:
    """Deliveries of some slots; odd: with late packets, or a betrayed state."""
    _n, trials = shape
    deliveries = []
    for k in range(FIRST, FIRST + int(random.integers(1, 6))):
        gamma, z = random.random(trials) < random.choice([0.0, 0.5, 1.0]), random.normal(size=shape)
        extra = random.integers(0, 5, (header, trials))
        late: tuple[Late, ...] = ()
        if odd and not gamma.all() and random.random() < 0.5:
            late = (Late(k - 2, Reception(~gamma, z, extra if header else None)),)
        truth = random.normal(size=shape).tobytes() if odd and random.random() < 0.3 else b""
        some = z[:, gamma].tobytes()
        deliveries.append(
            delivery(
                k, packed_flags(gamma).tobytes(), some, late, packed_header(extra, gamma) if header else b"", truth
            )
        )
    return deliveries


def readers(key: str, payloads: Sequence[bytes]) -> list[Reader]:
    """The messages, as they arrive."""
    return [Reader(key, payload) for payload in payloads]


@settings(deadline=None, max_examples=examples(60))
@given(RANDOM, SHAPES, st.sampled_from([0, 2]), st.booleans())
def test_packets_of_many_slots_are_those_of_each(
    random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool
) -> None:
    """Payloads, headers, what was not sent, and a betrayed state."""
    expect_same_packets(uplinks(random, shape, header, odd), shape, header)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("header", [0, 2])
@pytest.mark.parametrize("odd", [False, True])
def test_packets_of_many_slots_are_those_of_each_in_some_cases(seed: int, header: int, odd: bool) -> None:
    """The same cases in every run of the tests."""
    expect_same_packets(uplinks(np.random.default_rng(seed), (2, 9), header, odd), (2, 9), header)


def expect_same_packets(payloads: list[bytes], shape: tuple[int, int], header: int) -> None:
    """Packets that are read together are those that are read one by one."""
    uplinks = read_uplinks(readers(UP, payloads), FIRST, shape, header)
    for row, message in enumerate(readers(UP, payloads)):
        z, extras = read_uplink(message, FIRST + row, shape), read_extras(message, shape, header)
        assert uplinks.z[row].tobytes() == z.tobytes() == uplinks.whole[row]
        assert (uplinks.header is None) == (extras.header is None)
        if uplinks.header is not None and extras.header is not None:
            assert np.array_equal(uplinks.header[row], extras.header)
        if uplinks.sent is None:
            assert extras.sent is None
        else:
            assert np.array_equal(uplinks.sent[row], np.ones(shape[1]) if extras.sent is None else extras.sent)
        assert (row in uplinks.truth) == (extras.truth is not None)
        if extras.truth is not None:
            assert np.array_equal(uplinks.truth[row], extras.truth)


@settings(deadline=None, max_examples=examples(60))
@given(RANDOM, SHAPES, st.sampled_from([0, 2]), st.booleans())
def test_deliveries_of_many_slots_are_those_of_each(
    random: np.random.Generator, shape: tuple[int, int], header: int, odd: bool
) -> None:
    """γ, packets, headers, late packets, and a betrayed state."""
    expect_same_deliveries(deliveries(random, shape, header, odd), shape, header)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("header", [0, 2])
@pytest.mark.parametrize("odd", [False, True])
def test_deliveries_of_many_slots_are_those_of_each_in_some_cases(seed: int, header: int, odd: bool) -> None:
    """The same cases in every run of the tests."""
    expect_same_deliveries(deliveries(np.random.default_rng(seed), (2, 9), header, odd), (2, 9), header)


def expect_same_deliveries(payloads: list[bytes], shape: tuple[int, int], header: int) -> None:
    """Deliveries that are read together are those that are read one by one."""
    deliveries = read_deliveries(readers(DOWN, payloads), FIRST, shape, header, WINDOW)
    for row, message in enumerate(readers(DOWN, payloads)):
        expected, single = read_delivery(message, FIRST + row, shape, header, WINDOW), deliveries.at(row)
        for mine, other in zip(single.heard, expected.heard, strict=True):
            assert (mine is None) == (other is None)
            if mine is not None and other is not None:
                assert np.array_equal(mine, other)
        assert len(single.late) == len(expected.late)
        for late, like in zip(single.late, expected.late, strict=True):
            assert late.k == like.k
            assert np.array_equal(late.heard.z, like.heard.z)


SPOILT: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "another slot": lambda fields: {**fields, "k": 99},
    "a slot that is not a number": lambda fields: {**fields, "k": "8"},
    "NaN": lambda fields: {**fields, "z": np.full(2, np.nan).tobytes() + fields["z"][16:]},
    "too short": lambda fields: {**fields, "z": fields["z"][:-8]},
    "no bytes": lambda fields: {**fields, "z": [1.0]},
    "no packet": lambda fields: {name: value for name, value in fields.items() if name != "z"},
}
SPOILT_DELIVERIES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    **SPOILT,
    "a bit beyond the last trial": lambda fields: {**fields, "gamma": b"\xff"},
    "no mask": lambda fields: {name: value for name, value in fields.items() if name != "gamma"},
    "a mask that is too long": lambda fields: {**fields, "gamma": b"\x07\x00"},
    "packets for nobody": lambda fields: {**fields, "gamma": b"\x00"},
}


@pytest.mark.parametrize("place", [0, 2])
@pytest.mark.parametrize("case", SPOILT)
def test_the_malformed_packet_among_many_is_refused(case: str, place: int) -> None:
    """With the words in which it is refused alone."""
    fields = [{"k": FIRST + row, "z": np.ones((2, 3)).tobytes()} for row in range(4)]
    fields[place] = SPOILT[case](fields[place])
    messages = readers(UP, [pack(field) for field in fields])
    with pytest.raises((MalformedMessage, Gap)) as alone:
        read_uplink(messages[place], FIRST + place, (2, 3))
    with pytest.raises((MalformedMessage, Gap)) as among:
        read_uplinks(messages, FIRST, (2, 3))
    assert str(among.value) == str(alone.value)


@pytest.mark.parametrize("place", [0, 2])
@pytest.mark.parametrize("case", SPOILT_DELIVERIES)
def test_the_malformed_delivery_among_many_is_refused(case: str, place: int) -> None:
    """With the words in which it is refused alone."""
    fields = [{"k": FIRST + row, "gamma": b"\x07", "z": np.ones((2, 3)).tobytes()} for row in range(4)]
    fields[place] = SPOILT_DELIVERIES[case](fields[place])
    messages = readers(DOWN, [pack(field) for field in fields])
    with pytest.raises((MalformedMessage, Gap)) as alone:
        read_delivery(messages[place], FIRST + place, (2, 3))
    with pytest.raises((MalformedMessage, Gap)) as among:
        read_deliveries(messages, FIRST, (2, 3))
    assert str(among.value) == str(alone.value)


def test_the_headers_of_slots_in_which_nothing_arrives_are_0() -> None:
    """The messages have no header then, like those of a scheme without one."""
    messages = readers(DOWN, [pack({"k": FIRST + row, "gamma": b"\x00"}) for row in range(3)])
    deliveries = read_deliveries(messages, FIRST, (2, 3), 1)
    assert deliveries.header is not None
    assert np.array_equal(deliveries.header, np.zeros((3, 1, 3)))
