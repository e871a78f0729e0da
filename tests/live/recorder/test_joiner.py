"""The recorder joins the messages of all processes into slots: nothing is lost, moved or counted twice, however they are cut."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol import telemetry
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import Decisions, Extent, Journal, Report
from evedrop.live.recorder.joiner import Joiner
from evedrop.model.digest import Blocks
from evedrop.model.links.loss_model import REASONS
from evedrop.model.record import Record, columns
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots
from evedrop.score.slots import Slots
from tests.builders import mirrored
from tests.live.protocol.readers import delays_of

SLOTS, N, TRIALS, RECORDED = 300, 2, 5, 2
EXTENT = Extent(SLOTS, 300, N, TRIALS, RECORDED, inputs=1, measures=True, monitored=True)
WINDOWS = {"legitimate": 2, "eve": 0}
BLOCKS = Blocks(SLOTS)

RNG = np.random.default_rng(28)
TRUTH = SensorSlots(
    0,
    RNG.normal(size=(SLOTS, N, TRIALS)),
    RNG.random((SLOTS, TRIALS)) < 0.5,
    RNG.random((SLOTS, TRIALS)) < 0.5,
    RNG.random((SLOTS, TRIALS)) < 0.5,
    RNG.normal(size=(SLOTS, 1, TRIALS)),
    RNG.random((SLOTS, TRIALS)) < 0.5,
    RNG.normal(size=(SLOTS, N, TRIALS)),
    RNG.random((SLOTS, TRIALS)),
    RNG.normal(size=(SLOTS, 1, TRIALS)),
)


def report_of(window: int) -> Report:
    """What a receiver reports of all slots."""
    late = RNG.integers(0, window + 1, (SLOTS, TRIALS)).astype(np.uint16) if window else None
    slots = ReceiverSlots(
        0,
        RNG.normal(size=(SLOTS, N, TRIALS)),
        RNG.integers(0, 4, (SLOTS, TRIALS)).astype(np.uint8),
        mirrored(RNG.normal(size=(SLOTS, N, N, RECORDED))),
        RNG.random((SLOTS, 2)),
        late,
        None if late is None else late // 2,
    )
    return Report(
        slots,
        {block: RNG.integers(0, 256, (TRIALS, 16)).astype(np.uint8) for block in BLOCKS.ended(0, SLOTS)},
        {block: RNG.random(TRIALS) for block in BLOCKS.ended(0, SLOTS)},
    )


def link_of(window: int) -> LinkSlots:
    """What the router journals of all slots of a link; a different number of packets is lost for each reason."""
    delivered = RNG.random((SLOTS, TRIALS)) < 0.5
    unsent = (RNG.random(SLOTS) < 0.5).astype(np.uint32) * (~delivered).any(axis=1)
    missing = np.count_nonzero(~delivered, axis=1) - unsent
    kind = RNG.integers(0, len(REASONS) - (window == 0), SLOTS)  # without a window, none is under way
    lost = np.where(np.arange(len(REASONS)) == kind[:, None], missing[:, None], 0).astype(np.uint32)
    late = RNG.integers(0, window + 1, (SLOTS, TRIALS)).astype(np.uint16) if window else None
    return LinkSlots(0, delivered, lost, unsent.astype(np.uint32), late)


REPORTS = {name: report_of(window) for name, window in WINDOWS.items()}
LINKS = {name: link_of(window) for name, window in WINDOWS.items()}


def truth(start: int, stop: int) -> bytes:
    """The sensor's telemetry of some slots."""
    return telemetry.truth(TRUTH.rows(slice(start, stop)))


def report(name: str, start: int, stop: int) -> bytes:
    """A receiver's telemetry of some slots."""
    whole, ended = REPORTS[name], BLOCKS.ended(start, stop)
    digests = {block: whole.digests[block] for block in ended}
    return Report(
        whole.slots.rows(slice(start, stop)), digests, {block: whole.trace_sums[block] for block in ended}
    ).pack()


def journal(start: int, stop: int) -> bytes:
    """The router's journal of some slots."""
    slots = {name: link.rows(slice(start, stop)) for name, link in LINKS.items()}
    bursts = np.zeros(COUNTED_BURSTS, np.uint32)
    links = {name: Account(link, bursts, delays_of(link, WINDOWS[name])) for name, link in slots.items()}
    return Journal(start, stop - start, links).pack()


CUTS = {
    "truth": (0, 7, 8, 40, 100, 256, 300),
    "legitimate": (0, 8, 40, 48, 256, 300),
    "eve": (0, 40, 60, 256, 299, 300),
    "journal": (0, 3, 40, 90, 120, 300),
}
"""Sender → where its messages begin and end."""


def joiner_of() -> Joiner:
    """A joiner of that run, with a controller."""
    return Joiner(EXTENT, WINDOWS, dict.fromkeys((*WINDOWS, "controller"), BLOCKS), period=2)


def feed(joiner: Joiner, sender: str, start: int, stop: int) -> None:
    """Give the joiner one message."""
    if sender == "truth":
        joiner.add_truth(Reader("evedrop/r/telemetry/sensor", truth(start, stop)))
    elif sender == "journal":
        joiner.add_journal(Reader("evedrop/r/journal", journal(start, stop)))
    else:
        joiner.add_report(sender, Reader(f"evedrop/r/telemetry/{sender}", report(sender, start, stop)))


def in_turns(order: tuple[str, ...]) -> Iterator[tuple[str, int, int]]:
    """All messages: one of each sender, then the second of each, and so on."""
    pairs = {sender: list(pairwise(CUTS[sender])) for sender in order}
    for turn in range(max(map(len, pairs.values()))):
        for sender in order:
            if turn < len(pairs[sender]):
                yield (sender, *pairs[sender][turn])


@pytest.mark.parametrize(
    "messages",
    [
        list(in_turns(("truth", "journal", "legitimate", "eve"))),
        list(in_turns(("eve", "legitimate", "truth", "journal"))),
        [(sender, *pair) for sender in ("journal", "eve", "truth", "legitimate") for pair in pairwise(CUTS[sender])],
    ],
    ids=["in turns", "receivers first", "one after the other"],
)
def test_every_number_is_joined_in_its_place(messages: list[tuple[str, int, int]]) -> None:
    """The joined slots, one after the other, are what each process said of them; what nobody counted is 0."""
    joiner, joined = joiner_of(), list[Slots]()
    ends = dict.fromkeys(CUTS, 0)
    for sender, start, stop in messages:
        feed(joiner, sender, start, stop)
        ends[sender] = stop
        while (slots := joiner.take_slots()) is not None:
            assert slots.first == sum(part.count for part in joined)
            joined.append(slots)
        assert joiner.done == min(ends.values()) == sum(part.count for part in joined)
        assert (joiner.sent, joiner.journaled) == (ends["truth"], ends["journal"])
        assert joiner.places(["eve", "legitimate"]) == {
            "sensor": ends["truth"],
            "router": ends["journal"],
            "eve": ends["eve"],
            "legitimate": ends["legitimate"],
        }
    expect_equal(SensorSlots.joined([slots.sensor for slots in joined]), TRUTH)
    for name in WINDOWS:
        expect_equal(ReceiverSlots.joined([slots.receivers[name] for slots in joined]), REPORTS[name].slots)
        expect_equal(LinkSlots.joined([slots.links[name] for slots in joined]), LINKS[name])


def expect_equal(record: Record, expected: Record) -> None:
    """Check every column of a record."""
    assert record.slots == expected.slots
    for entry in columns(type(expected)):
        assert np.array_equal(getattr(record, entry.name), getattr(expected, entry.name)), entry.name


@pytest.mark.parametrize("missing", ["sent", "alarms"])
def test_a_column_that_comes_and_goes_is_refused(missing: str) -> None:
    """Slots of which only some say what was sent, or who was alarmed, could not be joined."""
    joiner = joiner_of()
    feed(joiner, "truth", 0, 7)
    other: dict[str, Any] = {missing: None}
    raw = telemetry.truth(replace(TRUTH.rows(slice(7, 8)), **other))
    with pytest.raises(MalformedMessage, match=f"{missing} in only some of the slots"):
        joiner.add_truth(Reader("evedrop/r/telemetry/sensor", raw))


def test_digests_and_sums_are_those_of_all_blocks() -> None:
    """Of each receiver, whichever message brings them; the sums of tr P are added in the order of the blocks."""
    joiner = joiner_of()
    for name in WINDOWS:
        for start, stop in pairwise(CUTS[name]):
            feed(joiner, name, start, stop)
        reported = REPORTS[name]
        assert {block: digest.tobytes() for block, digest in joiner.digests[name].items()} == {
            block: digest.tobytes() for block, digest in reported.digests.items()
        }
        assert np.array_equal(joiner.trace_sums[name], reported.trace_sums[0] + reported.trace_sums[256])
    assert set(joiner.trace_sums) == set(WINDOWS)


def test_a_run_is_complete_when_its_controller_has_reported_too() -> None:
    """Its decisions come in the order of their slots, one every two of them."""
    joiner = joiner_of()
    digests = {block: np.zeros((TRIALS, 16), np.uint8) for block in BLOCKS.ended(0, SLOTS)}
    assert joiner.reported("controller") == 0
    for sender, cuts in CUTS.items():
        for start, stop in pairwise(cuts):
            feed(joiner, sender, start, stop)
    while joiner.take_slots() is not None:
        pass
    assert joiner.done == SLOTS
    assert joiner.settled == 0
    assert not joiner.complete(SLOTS)
    for start, stop in ((0, 200), (200, SLOTS)):
        seconds = np.arange(start, stop, 2) / 1000.0
        ended = {block: digests[block] for block in BLOCKS.ended(start, stop)}
        message = Reader("evedrop/r/telemetry/controller", Decisions(start, stop - start, seconds, ended).pack())
        joiner.add_decisions(message)
        assert joiner.take_seconds() == seconds.tolist()
        assert joiner.reported("controller") == joiner.settled == stop
    assert joiner.complete(SLOTS)
    assert not joiner.complete(SLOTS + 1)
    assert sorted(joiner.digests["controller"]) == [0, 256]


def test_accounts_and_decisions_count_with_their_slots() -> None:
    """The router and the controller are ahead; what they did in slots that are not joined does not count yet."""
    joiner = joiner_of()
    for start, stop in pairwise(CUTS["journal"]):
        feed(joiner, "journal", start, stop)
    digests = {0: np.zeros((TRIALS, 16), np.uint8)}
    decisions = Decisions(0, 256, np.arange(0, 256, 2) / 1000.0, digests)
    joiner.add_decisions(Reader("evedrop/r/telemetry/controller", decisions.pack()))
    assert joiner.take_slots() is None
    assert (joiner.take_accounts(), joiner.take_seconds()) == ([], [])
    for sender, stop in (("truth", 7), ("legitimate", 8), ("eve", 40)):
        feed(joiner, sender, 0, stop)
    assert joiner.take_slots() is not None
    assert [accounts["eve"].slots.count for accounts in joiner.take_accounts()] == [3]
    assert joiner.take_seconds() == [0.0, 0.002, 0.004, 0.006]
    feed(joiner, "truth", 7, 8)
    assert joiner.take_slots() is not None
    assert (joiner.take_accounts(), joiner.take_seconds()) == ([], [])
