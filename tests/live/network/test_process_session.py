"""The messages that are kept for a lost connection, and sent again."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.errors import Gap
from evedrop.live.network.process_session import GapDetector, InOrder, ReplayBuffer
from tests.clock import clock_at_start, time_of_a_test


@pytest.fixture(autouse=True, scope="module")
def _time_of_the_tests() -> Iterator[None]:
    """The programs go by a clock of these tests."""
    with time_of_a_test():
        yield


def slot_message(k: int) -> bytes:
    """A message that belongs to slot k."""
    return bytes(msgpack.packb({"k": k}))


def head(number: int, k: int, first: int) -> bytes:
    """A message that says what follows it."""
    return bytes(msgpack.packb({"round": number, "from": k, "first": first}))


@given(
    slots=st.integers(0, 30),
    done=st.integers(0, 30),
    asked=st.integers(0, 35),
    back=st.integers(0, 5),
    span=st.none() | st.integers(0, 10),
)
def test_a_round_announces_the_slot_that_follows(
    slots: int, done: int, asked: int, back: int, span: int | None
) -> None:
    """However much was forgotten, however late a round is requested: the head names the next message, and none is missing."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append, span=span, head=head, back=back)
    for k in range(slots):
        kept(k, slot_message(k))
    kept.forget(min(done, slots))
    del sent[:]
    kept.again(7, asked)
    announced, *messages = [msgpack.unpackb(payload) for payload in sent]
    ks = [message["k"] for message in messages]
    assert announced["round"] == 7
    assert announced["from"] >= min(done, slots)
    wanted = list(range(announced["first"], slots))
    assert ks == wanted or (not wanted and ks in ([], [slots - 1]))
    assert announced["first"] <= max(asked, announced["from"])


def test_a_late_round_does_not_announce_what_is_forgotten() -> None:
    """A round from slot 0 on, asked for when 1184 slots were done, once made the reader wait for slot 0 in vain."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append, head=head, back=2)
    for k in range(1190):
        kept(k, slot_message(k))
    kept.forget(1184)
    del sent[:]
    kept.again(1, 0)
    assert msgpack.unpackb(sent[0]) == {"round": 1, "from": 1184, "first": 1182}
    assert [msgpack.unpackb(payload)["k"] for payload in sent[1:]] == [*range(1182, 1190)]


@pytest.mark.parametrize("k", [0, 5])
def test_the_last_message_is_sent_in_any_case(k: int) -> None:
    """A reader that has all of them hears that the sender is there."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append)
    kept(k, slot_message(k))
    del sent[:]
    kept.again(1, k + 1)
    assert sent == [slot_message(k)]


def test_a_buffer_with_a_span_keeps_the_slots_of_the_span() -> None:
    """Older slots, which are done, are not sent again; `back` slots more are kept."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append, span=4, head=head, back=1)
    for k in range(10):
        kept(k, slot_message(k))
    assert sent == [slot_message(k) for k in range(10)]
    del sent[:]
    kept.again(1, 0)
    assert sent == [head(1, 5, 4), *(slot_message(k) for k in range(4, 10))]


BLOCKS = st.lists(st.integers(1, 7), max_size=12)
"""How many slots each message has."""


def block_message(first: int, count: int) -> bytes:
    """A message of several slots."""
    return bytes(msgpack.packb({"k": first, "c": count}))


@given(BLOCKS, st.integers(0, 90), st.integers(0, 90), st.integers(0, 5))
def test_a_message_of_several_slots_is_kept_until_all_of_them_are_done(
    counts: list[int], done: int, asked: int, back: int
) -> None:
    """A resend begins with the first slot of the oldest message that is sent again, and no slot that is needed is missing."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append, head=head, back=back)
    slots = 0
    for count in counts:
        kept(slots + count - 1, block_message(slots, count), slots)
        slots += count
    done = min(done, slots)
    kept.forget(done)
    del sent[:]
    kept.again(3, asked)
    announced, *messages = [msgpack.unpackb(payload) for payload in sent]
    needed = max(0, max(done, asked) - back)
    assert announced["from"] == max(done, asked)
    if needed < slots:
        ks = [k for message in messages for k in range(message["k"], message["k"] + message["c"])]
        assert ks == [*range(announced["first"], slots)]
        assert messages[0]["k"] == announced["first"] <= needed < messages[0]["k"] + messages[0]["c"]


def test_a_message_with_a_slot_that_is_not_done_is_sent_again_as_it_was() -> None:
    """With its slots that are done, which the announcement says."""
    sent: list[bytes] = []
    kept = ReplayBuffer(sent.append, head=head, back=1)
    for first in range(0, 24, 8):
        kept(first + 7, block_message(first, 8), first)
    kept.forget(11)
    del sent[:]
    kept.again(1, 11)
    assert sent == [head(1, 11, 8), block_message(8, 8), block_message(16, 8)]
    kept.forget(16)  # slot 15 is still needed, for what is under way
    del sent[:]
    kept.again(2, 16)
    assert sent == [head(2, 16, 8), block_message(8, 8), block_message(16, 8)]
    kept.forget(17)
    del sent[:]
    kept.again(3, 17)
    assert sent == [head(3, 17, 16), block_message(16, 8)]


KEY = "evedrop/r/uplink"


def test_a_slot_that_is_missing_is_waited_for() -> None:
    """For the patience, from the first later slot on, and not longer; earlier slots do not count."""
    clock, gap = clock_at_start(), GapDetector(KEY, 5.0)
    gap.missed(7, 6)
    clock.now += 100.0
    for _ in range(5):
        gap.missed(7, 9)
        clock.now += 1.0
    gap.missed(7, 10)
    clock.now += 0.5
    gap.missed(7, 6)
    with pytest.raises(Gap) as raised:
        gap.missed(7, 8)
    assert str(raised.value) == str(Gap(KEY, 7, 8))


def test_another_slot_that_is_missing_is_waited_for_as_long() -> None:
    """The time of the slot before it does not count."""
    clock, gap = clock_at_start(), GapDetector(KEY, 5.0)
    for _ in range(4):
        gap.missed(0, 3)
        clock.now += 1.0
    for _ in range(5):
        gap.missed(2, 3)
        clock.now += 1.2
    with pytest.raises(Gap):
        gap.missed(2, 3)


def test_a_short_patience_is_longer() -> None:
    """The recorder, which lets the slot be sent again, needs some seconds to notice that it is missing."""
    clock, gap = clock_at_start(), GapDetector(KEY, 0.0)
    for _ in range(4):
        gap.missed(7, 9)
        clock.now += 1.0
    gap.missed(7, 9)
    clock.now += 0.5
    with pytest.raises(Gap):
        gap.missed(7, 9)


def test_time_in_which_nothing_ran_hardly_counts() -> None:
    """A process that was suspended finds later messages at once, and the missing one may come yet."""
    clock, gap = clock_at_start(), GapDetector(KEY, 30.0)
    for _ in range(5):
        gap.missed(7, 9)
        clock.now += 3600.0
    with pytest.raises(Gap):
        gap.missed(7, 9)


def test_the_message_of_the_slot_that_is_due_is_taken() -> None:
    """Those of earlier and later slots that come before it are left out."""
    clock, coming = clock_at_start(), iter([3, 6, 5])

    def received() -> bytes:
        clock.now += 3.0
        return slot_message(next(coming, 8))

    messages = InOrder(SimpleNamespace(recv=received), KEY, 5.0)  # type: ignore[arg-type]
    assert messages.take(5).integer("k") == 5
    with pytest.raises(Gap):
        messages.take(6)
