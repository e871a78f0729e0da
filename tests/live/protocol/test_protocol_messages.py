"""Messages, both ways, over all shapes; what is refused, and how."""

from __future__ import annotations

import contextlib
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evedrop.errors import EvedropError, Gap, MalformedMessage, RunError
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.keys import writer_of
from evedrop.live.recorder.joiner import Joiner
from evedrop.model.digest import Blocks
from evedrop.model.links.loss_model import REASONS
from evedrop.model.receiver import Belief, Reception
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.link_core import Arrivals, Late
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots
from tests.builders import mirrored
from tests.examples import examples
from tests.live.protocol.readers import EXAMPLES, READERS, delays_of, fields_of

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
SLOTS = st.integers(0, 2**40)
SIZES = st.integers(1, 19)


def extent(n: int, trials: int, recorded: int = 1) -> telemetry.Extent:
    """What messages of a run of many slots are held to."""
    return telemetry.Extent(2**41, 5, n, trials, recorded)


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 5), st.integers(1, 4), SIZES, st.integers(0, 2))
def test_packets(data: st.DataObject, k: int, c: int, n: int, trials: int, h: int) -> None:
    """Packets read back bit by bit, negative zeros and subnormal numbers included, with header and what was sent."""
    sent = PacketSlots(
        k,
        data.draw(arrays(float, (c, n, trials), elements=FINITE)),
        data.draw(arrays(np.int64, (c, h, trials))) if h else None,
        data.draw(st.one_of(st.none(), arrays(bool, (c, trials)))),
    )
    read = packets.read_uplink(Reader("u", packets.uplink(sent)), k, packets.packet_format(n, trials, h), 5)
    assert read.slots == sent.slots
    for name in ("z", "header", "sent"):
        column, expected = getattr(read, name), getattr(sent, name)
        assert (column is None) == (expected is None)
        assert column is None or column.tobytes() == expected.tobytes()


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 5), st.integers(1, 4), SIZES, st.integers(0, 2))
def test_delivery(data: st.DataObject, k: int, c: int, n: int, trials: int, h: int) -> None:
    """A receiver gets γ, and z and header of exactly the trials that received; of the others not a bit is in the message."""
    z = data.draw(arrays(float, (c, n, trials), elements=FINITE))
    gamma = data.draw(arrays(bool, (c, trials)))
    header = data.draw(arrays(np.int64, (c, h, trials))) if h else None
    raw = packets.delivery(range(k, k + c), Arrivals(gamma, z, header))
    read = packets.read_delivery(Reader("d", raw), k, (n, trials), h, most=5)
    assert np.array_equal(read.gamma, gamma)
    assert read.z.tobytes() == np.where(gamma[:, None], z, 0.0).tobytes()
    assert (read.header is None) == (header is None)
    if header is not None and read.header is not None:
        assert np.array_equal(read.header, np.where(gamma[:, None], header, 0))
    assert not read.late
    fields = msgpack.unpackb(raw)
    assert len(fields.get("z", b"")) == 8 * n * gamma.sum()
    assert len(fields.get("header", b"")) == 8 * h * gamma.sum()


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 3), SIZES, st.integers(0, 3))
def test_delivery_with_late_packets(data: st.DataObject, k: int, n: int, trials: int, count: int) -> None:
    """Late packets read back with their slots, in order, each with z of exactly the trials that it arrived in."""
    late = tuple(
        Late(
            data.draw(st.integers(0, k)),
            Reception(
                data.draw(arrays(bool, trials).filter(np.any)),
                data.draw(arrays(float, (n, trials), elements=FINITE)),
            ),
        )
        for _ in range(min(count, 2 * (k + 1)))
    )
    row = data.draw(st.integers(0, min(2, k)))
    nothing = np.zeros((row + 1, trials), bool), np.zeros((row + 1, n, trials))
    raw = packets.delivery(range(k - row, k + 1), Arrivals(*nothing, None, {row: late} if late else {}))
    read = packets.read_delivery(Reader("d", raw), k - row, (n, trials), most=3)
    assert not read.gamma.any()
    assert read.late.keys() <= {row}
    arrived = read.late.get(row, ())
    assert [packet.k for packet in arrived] == [packet.k for packet in late]
    for packet, sent in zip(arrived, late, strict=True):
        assert np.array_equal(packet.heard.gamma, sent.heard.gamma)
        assert packet.heard.z.tobytes() == np.where(sent.heard.gamma, sent.heard.z, 0.0).tobytes()
    sizes = [len(entry["z"]) for entry in msgpack.unpackb(raw).get("late", [])]
    assert sizes == [8 * n * packet.heard.gamma.sum() for packet in late]


def late_delivery(k: int, late: tuple[Late, ...]) -> bytes:
    """A delivery in which nothing but late packets arrives, in one trial of one state."""
    return packets.delivery(range(k, k + 1), Arrivals(np.zeros((1, 1), bool), np.zeros((1, 1, 1)), None, {0: late}))


def test_a_late_packet_from_the_future_is_refused() -> None:
    """What arrives in slot 4 was not sent in slot 5."""
    late = (Late(5, Reception(np.ones(1, bool), np.zeros((1, 1)))),)
    with pytest.raises(MalformedMessage, match="a late packet of slot 5; expected one of slot 4 or before"):
        packets.read_delivery(Reader("d", late_delivery(4, late)), 4, (1, 1))


@given(SLOTS)
def test_marks(k: int) -> None:
    """A mark is neither packet nor delivery, a word that the sensor holds is not truth, and each says before which slot."""
    mark, held = Reader("u", packets.barrier(k)), Reader("t", telemetry.held(k))
    assert (
        packets.is_barrier(mark),
        packets.is_barrier(Reader("u", packets.uplink(PacketSlots(k, np.zeros((1, 1, 1)))))),
    ) == (
        True,
        False,
    )
    truth = telemetry.truth(SensorSlots(k, np.zeros((1, 1, 1)), np.zeros((1, 1), bool)))
    assert (telemetry.is_held(held), telemetry.is_held(Reader("t", truth))) == (True, False)
    assert mark.slot(k) == held.slot(k) == k


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 3), SIZES)
def test_leaving(data: st.DataObject, k: int, n: int, trials: int) -> None:
    """A receiver's last word reads back bit by bit."""
    x_hat = data.draw(arrays(float, (n, trials), elements=FINITE))
    P = mirrored(data.draw(arrays(float, (n, n, trials), elements=FINITE)))
    message = Reader("t", telemetry.leaving(k, Belief(x_hat, P, np.ones(trials, np.uint8))))
    assert telemetry.is_leaving(message)
    slot, belief = telemetry.read_leaving(message, extent(n, trials))
    assert (slot, belief.x_hat.tobytes(), belief.P.tobytes()) == (k, x_hat.tobytes(), P.tobytes())
    assert not belief.action.any()


@settings(deadline=None)
@given(st.data(), SLOTS, st.integers(1, 3), SIZES, st.integers(1, 5))
def test_truth(data: st.DataObject, k: int, n: int, trials: int, count: int) -> None:
    """Truth reads back."""
    x = data.draw(arrays(float, (count, n, trials), elements=FINITE))
    nu = data.draw(arrays(bool, (count, trials)))
    truth = telemetry.read_truth(Reader("t", telemetry.truth(SensorSlots(k, x, nu))), k, extent(n, trials))
    assert (truth.first, truth.count, truth.x.tobytes()) == (k, count, x.tobytes())
    assert np.array_equal(truth.nu, nu)


@settings(deadline=None)
@given(st.data(), st.integers(0, 4000), st.integers(1, 3), SIZES, st.integers(1, 5))
def test_report(data: st.DataObject, k: int, n: int, trials: int, count: int) -> None:
    """A report reads back, with the digests of the blocks that end in it."""
    recorded = data.draw(st.integers(1, trials))
    slots, window = k + count + data.draw(st.integers(0, 2)), data.draw(st.integers(0, 9))
    blocks = Blocks(slots, data.draw(st.sets(st.integers(k, k + count), max_size=2)))
    late = data.draw(arrays(np.uint16, (count, trials), elements=st.integers(0, window))) if window else None
    sent = ReceiverSlots(
        k,
        data.draw(arrays(float, (count, n, trials), elements=FINITE)),
        data.draw(arrays(np.uint8, (count, trials), elements=st.integers(0, 3))),
        mirrored(data.draw(arrays(float, (count, n, n, recorded), elements=FINITE))),
        data.draw(arrays(float, (count, 2), elements=FINITE)),
        late,
        None if late is None else late // 2,
    )
    report = telemetry.Report(
        sent,
        {block: data.draw(arrays(np.uint8, (trials, 16))) for block in blocks.ended(k, k + count)},
        {block: np.abs(data.draw(arrays(float, trials, elements=FINITE))) for block in blocks.ended(k, k + count)}
        if recorded < trials
        else {},
    )
    of_run = replace(extent(n, trials, recorded), slots=slots)
    result = telemetry.read_report(Reader("r", report.pack()), k, of_run, blocks, window)
    for name in ("x_hat", "action", "P", "trace"):
        assert getattr(result.slots, name).tobytes() == getattr(sent, name).tobytes()
    assert {b: d.tobytes() for b, d in result.digests.items()} == {b: d.tobytes() for b, d in report.digests.items()}
    assert {b: s.tobytes() for b, s in result.trace_sums.items()} == {
        b: s.tobytes() for b, s in report.trace_sums.items()
    }
    assert result.slots.count == count
    for name in ("late", "late_used"):
        assert np.array_equal(getattr(result.slots, name), getattr(sent, name))


def account_of(delivered: np.ndarray, window: int = 0, **changes: Any) -> Account:
    """The account of a link that only loses; changes replace its columns."""
    count, trials = delivered.shape
    lost = np.zeros((count, len(REASONS)), np.uint32)
    lost[:, 0] = trials - delivered.sum(axis=1)
    late = np.zeros((count, trials), np.uint16) if window else None
    slots = replace(LinkSlots(0, delivered, lost, np.zeros(count, np.uint32), late), **changes)
    return Account(slots, np.zeros(COUNTED_BURSTS, np.uint32), delays_of(slots, window))


@settings(deadline=None)
@given(st.data(), SLOTS, SIZES, st.integers(1, 5))
def test_journal(data: st.DataObject, k: int, trials: int, count: int) -> None:
    """A journal reads back, receiver by receiver, reason by reason."""
    windows = {"legitimate": 0, "eve": 3, "mallory": 1000}
    links = {}
    for name, window in windows.items():
        delivered = data.draw(arrays(bool, (count, trials)))
        most = (trials - delivered.sum(axis=1)).astype(np.uint32)
        unsent = data.draw(arrays(np.uint32, count, elements=st.integers(0, trials))) % (most + 1)
        lost = np.zeros((count, len(REASONS)), np.uint32)
        # The last reason is that a packet is under way, as none is without a window.
        lost[:, data.draw(st.integers(0, len(REASONS) - 1 - (window == 0)))] = most - unsent
        late = data.draw(arrays(np.uint16, (count, trials), elements=st.integers(0, window))) if window else None
        slots = LinkSlots(k, delivered, lost, unsent, late)
        bursts = data.draw(arrays(np.uint32, 64, elements=st.integers(0, count * trials)))
        links[name] = Account(slots, bursts, delays_of(slots, window))
    raw = telemetry.Journal(k, count, links).pack()
    journal = telemetry.read_journal(Reader("j", raw), k, windows, extent(1, trials))
    assert (journal.first, journal.count, set(journal.links)) == (k, count, set(links))
    for name, link in links.items():
        for column in ("bursts", "delays"):
            assert np.array_equal(getattr(journal.links[name], column), getattr(link, column))
        for column in ("delivered", "lost", "unsent", "late"):
            assert np.array_equal(getattr(journal.links[name].slots, column), getattr(link.slots, column)), column


def refused(read: Callable[[bytes], Any], raw: bytes) -> MalformedMessage | Gap | None:
    """How a reader refuses a message; None if it takes it."""
    try:
        read(raw)
    except (MalformedMessage, Gap) as error:
        return error
    return None


def parts() -> st.SearchStrategy[Any]:
    """Anything that msgpack can carry, with the lengths of arrays that readers expect among the bytes."""
    names = sorted({field for name in EXAMPLES for field in fields_of(name)})
    leaves = st.one_of(
        st.integers(-(2**63), 2**64 - 1),
        st.sampled_from([None, True, 0.5, float("nan"), "", "start", "eve", "evedrop/r1/uplink"]),
        st.sampled_from([0, 1, 2, 3, 4, 6, 8, 16, 24, 48, 96, 192, 256]).map(bytes),
        st.sampled_from([1, 6, 12, 24, 48, 96]).map(lambda size: b"\xff" * size),
        st.binary(max_size=9),
    )
    keys = st.one_of(st.sampled_from([*names, *REASONS, "eve", "legitimate", "lost", "bursts"]), st.integers(-1, 2**63))
    return st.recursive(
        leaves,
        lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(keys, inner, max_size=4)),
        max_leaves=8,
    )


@settings(deadline=None, max_examples=examples(200))
@given(st.data(), st.sampled_from(sorted(READERS)))
def test_anything_else_is_an_error_of_ours(data: st.DataObject, name: str) -> None:
    """For any bytes, a reader returns values or raises one of the two errors of messages, which names the key and its writer."""
    key, read = READERS[name]
    fields = fields_of(name)
    for field in data.draw(st.sets(st.sampled_from(sorted(fields)), max_size=2)):
        fields[field] = data.draw(parts())
    for field in data.draw(st.sets(st.sampled_from(sorted(fields)), max_size=1)):
        del fields[field]
    raw = data.draw(st.one_of(st.just(msgpack.packb(fields)), st.binary(max_size=60), parts().map(msgpack.packb)))
    error = refused(read, raw)
    assert error is None or key in str(error)
    assert error is None or error.at_fault == (writer_of(key),)
    assert error is None or len(str(error)) < 1500


@pytest.mark.parametrize("name", sorted(READERS))
def test_examples_are_read(name: str) -> None:
    """The message that a reader's fuzzing begins with is one that it takes, and without any one byte it is not another error."""
    assert READERS[name][1](EXAMPLES[name]) is not None
    for place in range(len(EXAMPLES[name])):
        with contextlib.suppress(MalformedMessage, Gap):
            READERS[name][1](EXAMPLES[name][:place] + EXAMPLES[name][place + 1 :])


BOMBS = {
    "a list of lists": b"\xdd\x00\x98\x96\x80" + b"\x90" * 10**7,
    "a list of maps in a map": b"\x81\xa1k\xdd\x00\x98\x96\x80" + b"\x80" * 10**7,
    "lists one after the other": b"\x90" * 10**7,
    "lists of lists of lists": b"\x81\xa1k"
    + b"\xdc\x01\x00"
    + (b"\xdc\x01\x00" + (b"\x9f" + b"\x90" * 15) * 256) * 256,
    "a long list that is cut": b"\xdd\xff\xff\xff\xff",
    "a long text that is cut": b"\x81\xa1k\xdb\xff\xff\xff\xff",
    "lists without an end": b"\x91" * 10**6,
}
"""Messages of some megabytes that are much larger once they are read."""


@pytest.mark.parametrize("case", BOMBS)
def test_a_large_message_is_refused_before_it_is_larger(case: str) -> None:
    """However it is made, reading it takes some megabytes more than it has at most, and the error shows a part of it alone."""
    tracemalloc.start()
    try:
        with pytest.raises(MalformedMessage, match="not msgpack") as raised:
            Reader("evedrop/r1/telemetry/eve", BOMBS[case])
        assert tracemalloc.get_traced_memory()[1] < 4e6 + (len(BOMBS[case]) if "after" in case else 0)
    finally:
        tracemalloc.stop()
    assert len(str(raised.value)) < 1000


def test_errors_say_what_was_found_where_and_what_to_do() -> None:
    """A malformed message shows key, found, expected and the bytes; a gap both slots; either ends with a remedy."""
    carried = packets.packet_format(2, 3)
    with pytest.raises(MalformedMessage) as malformed:
        packets.read_uplink(Reader("evedrop/r/uplink", packets.uplink(PacketSlots(0, np.zeros((1, 2, 2))))), 0, carried)
    assert str(malformed.value).startswith(
        "malformed message on evedrop/r/uplink: z of 32 bytes; expected 48 bytes, <f8 of shape (1, 2, 3). Its 43 bytes: 83 a1 6b"
    )
    with pytest.raises(Gap) as gap:
        packets.read_uplink(Reader("evedrop/r/uplink", packets.uplink(PacketSlots(7, np.zeros((1, 2, 3))))), 6, carried)
    assert "gap on evedrop/r/uplink: slot 7 arrived where slot 6 was due" in str(gap.value)
    assert issubclass(Gap, RunError)
    assert issubclass(MalformedMessage, RunError)
    assert issubclass(RunError, EvedropError)


@pytest.mark.parametrize("value", [4, 255])
def test_unknown_actions_are_refused(value: int) -> None:
    """An action beyond the documented four is malformed."""
    slots = ReceiverSlots(
        0, np.zeros((1, 1, 1)), np.full((1, 1), value, np.uint8), np.zeros((1, 1, 1, 1)), np.zeros((1, 2))
    )
    report = telemetry.Report(slots, {})
    with pytest.raises(MalformedMessage, match=f"action of {value}; expected numbers from 0 to 3"):
        telemetry.read_report(Reader("key", report.pack()), 0, extent(1, 1), Blocks(9))


@pytest.mark.parametrize(
    ("sums", "recorded", "message"),
    [
        ({}, 1, "trace_sums of blocks []; expected those of [0]"),
        ({0: np.ones(2)}, 2, "trace_sums of blocks [0]; expected those of []"),
        ({4: np.ones(2)}, 1, "trace_sums of blocks [4]; expected those of [0]"),
        ({0: np.ones(3)}, 1, "trace_sums of block 0; expected 16 bytes a block"),
        ({0: np.array([1.0, -1.0])}, 1, "with a number below 0, or not finite; expected sums of traces"),
        ({0: np.array([1.0, np.inf])}, 1, "with a number below 0, or not finite; expected sums of traces"),
    ],
)
def test_wrong_sums_of_traces_are_refused(sums: dict[int, np.ndarray], recorded: int, message: str) -> None:
    """They are of the blocks that end in the slots, if not all trials are recorded, and of every trial."""
    P, digests = np.zeros((1, 1, 1, recorded)), {0: np.zeros((2, 16), np.uint8)}
    slots = ReceiverSlots(0, np.zeros((1, 1, 2)), np.zeros((1, 2), np.uint8), P, np.zeros((1, 2)))
    report = telemetry.Report(slots, digests, sums)
    with pytest.raises(MalformedMessage, match=re.escape(message)):
        telemetry.read_report(Reader("key", report.pack()), 0, replace(extent(1, 2, recorded), slots=1), Blocks(1))


def test_a_journal_without_a_receiver_is_refused() -> None:
    """Every receiver must be in every journal message."""
    raw = telemetry.Journal(0, 1, {"a": account_of(np.ones((1, 3), bool))}).pack()
    with pytest.raises(MalformedMessage, match="b = None; expected a map b"):
        telemetry.read_journal(Reader("key", raw), 0, {"a": 0, "b": 2}, extent(1, 3))


@pytest.mark.parametrize("reasons", [0, 1, 7, 9])
def test_a_journal_with_other_reasons_is_refused(reasons: int) -> None:
    """A journal counts for every reason of the links and for no other: columns of messages must fit together."""
    account = account_of(np.ones((1, 3), bool))
    wrong = replace(account, slots=replace(account.slots, lost=np.zeros((1, reasons), np.uint32)))
    raw = telemetry.Journal(0, 1, dict.fromkeys("ab", wrong)).pack()
    with pytest.raises(
        MalformedMessage, match=rf"lost of {4 * reasons} bytes; expected 32 bytes, <u4 of shape \(1, 8\)"
    ):
        telemetry.read_journal(Reader("key", raw), 0, {"a": 0, "b": 2}, extent(1, 3))


TELEMETRY = {
    "truth": lambda k: telemetry.truth(SensorSlots(k, np.zeros((2, 1, 3)), np.zeros((2, 3), bool))),
    "report": lambda k: telemetry.Report(
        ReceiverSlots(k, np.zeros((2, 1, 3)), np.zeros((2, 3), np.uint8), np.zeros((2, 1, 1, 1)), np.zeros((2, 2))),
        {},
    ).pack(),
    "journal": lambda k: telemetry.Journal(k, 2, {"a": account_of(np.ones((2, 3), bool))}).pack(),
}


@pytest.mark.parametrize("second", [0, 1, 3, 4])
@pytest.mark.parametrize("case", TELEMETRY)
def test_recorder_notices_gaps_and_doubles(case: str, second: int) -> None:
    """Truth, report or journal that does not begin where the last one ended is a gap."""
    joiner = Joiner(extent(1, 3), {"a": 0}, {"a": Blocks(9)})
    takes: dict[str, Callable[[bytes], object]] = {
        "truth": lambda raw: joiner.add_truth(Reader("key", raw)),
        "report": lambda raw: joiner.add_report("a", Reader("key", raw)),
        "journal": lambda raw: joiner.add_journal(Reader("key", raw)),
    }
    take = takes[case]
    take(TELEMETRY[case](0))
    with pytest.raises(Gap, match=f"gap on key: slot {second} arrived where slot 2 was due"):
        take(TELEMETRY[case](second))
    take(TELEMETRY[case](2))
