"""How large messages may be, and how many may wait: what a run sends always fits."""

from __future__ import annotations

from queue import Empty

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.errors import MalformedMessage
from evedrop.live.launch.briefs import flow_of
from evedrop.live.network.process_session import Mailbox, allowance
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol import telemetry as loop_wire
from evedrop.live.protocol.codec import head_of
from evedrop.live.protocol.commands import Again, ProcessStatus
from evedrop.live.protocol.keys import Sizes
from evedrop.live.protocol.notices import Progress, RefusalNotice
from evedrop.model.digest import BLOCK_SLOTS
from evedrop.model.links.loss_model import REASONS
from evedrop.model.receiver import Belief, Reception
from evedrop.model.slot.link import COUNTED_BURSTS, Account, Change
from evedrop.model.slot.link_core import Arrivals, Late
from evedrop.model.slot.records import LinkSlots, PacketSlots, ReceiverSlots, SensorSlots
from evedrop.scenario.loading import load
from tests.examples import examples
from tests.live.protocol.made_briefs import briefed

SIZES = st.builds(
    Sizes,
    n=st.integers(1, 4),
    trials=st.sampled_from([1, 7, 8, 200]),
    recorded=st.just(1),
    batch=st.integers(1, 40),
    window=st.integers(0, 5),
    receivers=st.integers(1, 5),
    header=st.integers(0, 2),
    inputs=st.integers(0, 3),
    period=st.integers(1, 50),
    message=st.integers(1, 64),
)


def digests_of(blocks: int, trials: int) -> dict[int, np.ndarray]:
    """Digests of this many blocks."""
    return {2**40 + block: np.ones((trials, 16), np.uint8) for block in range(blocks)}


def largest(sizes: Sizes) -> dict[str, bytes]:
    """Kind of key → the largest message on it."""
    n, R, c, recorded = sizes.n, sizes.trials, sizes.batch, sizes.recorded
    z, all_of, k, some = np.ones((n, R)), np.ones(R, bool), 2**40, sizes.message
    header = np.ones((some, sizes.header, R), np.int64) if sizes.header else None
    heard = Reception(all_of, z, None if header is None else header[0])
    late = tuple(Late(k, heard) for _ in range(2 * (sizes.window + 1)))
    sent = PacketSlots(k, np.ones((some, n, R)), header, np.ones((some, R), bool), np.ones((some, n, R)))
    gamma = np.ones((some, R), bool)
    truths = dict(enumerate(np.ones((some, n, R))))
    arrivals = Arrivals(gamma, np.ones((some, n, R)), header, dict.fromkeys(range(some), late), truths)
    digests = digests_of(c // BLOCK_SLOTS + 2, R)
    u = np.ones((c, sizes.inputs, R)) if sizes.inputs else None
    flags, counts = np.ones((c, R), bool), np.ones((c, R), np.uint16)
    lost = np.ones((c, len(REASONS)), np.uint32)
    bursts, delays = np.ones(COUNTED_BURSTS, np.uint32), np.ones(sizes.window + 2, np.uint32)
    account = Account(LinkSlots(k, flags, lost, np.ones(c, np.uint32), counts), bursts, delays)
    truth = SensorSlots(
        k, np.ones((c, n, R)), flags, flags, flags, u, flags if sizes.inputs else None, np.ones((c, n, R)),
        np.ones((c, R)), u,
    )  # fmt: skip
    report = telemetry.Report(
        ReceiverSlots(
            k,
            np.ones((c, n, R)),
            counts.astype(np.uint8),
            np.ones((c, n, n, recorded)),
            np.ones((c, 2)),
            counts,
            counts,
        ),
        digests,
        {block: np.ones(R) for block in digests} if recorded < R else {},
    )
    seconds = np.ones(c // sizes.period + 2)
    reports = [
        telemetry.truth(truth),
        report.pack(),
        telemetry.leaving(k, Belief(z, np.ones((n, n, R)), np.ones(R, np.uint8))),
        loop_wire.Decisions(k, c, seconds, digests_of((c + sizes.period) // BLOCK_SLOTS + 1, R)).pack(),
        ProcessStatus(k, tuple("evedrop/r0123abcd/progress/" + "n" * 32 for _ in range(sizes.receivers + 1))).pack(),
        RefusalNotice.of("evedrop/r0123abcd/progress/" + "n" * 32, "x" * 1000).pack(),
    ]
    names = [f"{i:032}" for i in range(sizes.receivers)]
    return {
        "uplink": packets.uplink(sent),
        "downlink": packets.delivery(range(k, k + some), arrivals),
        "ack": packets.acknowledgement(k, all_of),
        "estimate": loop_wire.known("x_hat", k, z),
        "state": loop_wire.known("x", k, z),
        "input": loop_wire.decided(k, np.ones((sizes.inputs, R)), all_of),
        "telemetry": max(reports, key=len),
        "journal": telemetry.Journal(k, c, dict.fromkeys(names, account)).pack(),
        "progress": Progress(k).pack(),
        "control": Again(k, k, {name: (Change(k, cut=True),) * 100 for name in names}).pack(),
    }


@settings(max_examples=examples(100))
@given(SIZES)
def test_whatever_a_run_sends_fits(sizes: Sizes) -> None:
    """The largest message of every kind is within its limit, and the limit is not far above it where messages are large."""
    expect_that_all_fit(sizes)


@pytest.mark.parametrize("rest", [(0, 1), (40, 5, 2, 3, 900, 1), (3, 2, 1, 0, 1, 64), (0, 3, 0, 1)])
@pytest.mark.parametrize(
    "shape", [(1, 1, 1, 1024), (4, 200, 1, 1), (4, 40, 40, 300), (1, 200, 1, 600), (2, 1000, 1, 1)]
)
def test_whatever_a_run_sends_fits_at_the_extremes(shape: tuple[int, int, int, int], rest: tuple[int, ...]) -> None:
    """Where each kind of report is the largest: with many slots in one, or with many trials, all of them recorded or one."""
    expect_that_all_fit(Sizes(*shape, *rest))


def expect_that_all_fit(sizes: Sizes) -> None:
    """Check the largest message of every kind against its limit."""
    for kind, message in largest(sizes).items():
        limit = sizes.of_kinds[kind]
        assert len(head_of("evedrop/r0123abcd/telemetry/" + "n" * 32)) + len(message) <= limit, kind
        if kind != "control":
            assert limit <= 3 * len(message) + 5000 * (sizes.receivers + 1), kind


@pytest.mark.parametrize("window", [0, 6, 100, 1000, 10_000])
def test_a_message_of_many_slots_with_every_late_packet_is_read(window: int) -> None:
    """In each slot, the packets of every slot of the window and their copies: a reader takes only so many maps."""
    scenario = briefed(legitimate={"window": window, "link": {"quality": 0.9}}, trials=8, slots=5000)
    c, n = flow_of(scenario).message, len(scenario.process.A)
    assert c == {0: 64, 6: 64, 100: 64, 1000: 10, 10_000: 1}[window]
    heard = Reception(np.ones(8, bool), np.ones((n, 8)))
    k = 2 * window
    late = {row: tuple(Late(k + row - back, heard) for back in range(window + 1) for _ in range(2)) for row in range(c)}
    gamma = np.ones((c, 8), bool)
    raw = packets.delivery(range(k, k + c), Arrivals(gamma, np.ones((c, n, 8)), None, late))
    read = packets.read_delivery(wire.Reader("evedrop/r/downlink/legitimate", raw), k, (n, 8), 0, window, c)
    assert [len(read.late[row]) for row in range(c)] == [2 * (window + 1)] * c


def test_what_waits_is_bounded_by_sender() -> None:
    """A sender of more than a run can have under way is named when the reader comes to it; earlier messages are not lost."""
    mailbox = Mailbox({"eve": "evedrop/r/telemetry/eve", "sensor": "evedrop/r/telemetry/sensor"}, 10_000)
    for _ in range(3):
        mailbox.put("eve", bytes(2000))
        assert mailbox.get() == ("eve", bytes(2000))
    mailbox.put("sensor", b"truth")
    mailbox.put("eve", True)
    assert [mailbox.get(), mailbox.get()] == [("sensor", b"truth"), ("eve", True)]
    with pytest.raises(Empty):
        mailbox.get(timeout=0.0)
    for _ in range(100):
        mailbox.put("eve", bytes(2000))
    with pytest.raises(MalformedMessage, match="telemetry/eve: more than 10000 unread bytes") as raised:
        mailbox.get()
    assert raised.value.at_fault == ("eve",)
    assert len(mailbox) < 10


def test_what_may_wait_is_measured_by_reports() -> None:
    """Not by the largest message, which is a command: a sender could fill the memory before its flood ends the run."""
    flow = flow_of(load("eavesdroppers"))
    assert allowance(flow.largest_report, flow.window, flow.batch) < 2**25 < flow.largest_message


def test_a_window_in_some_rounds_is_allowed() -> None:
    """All that is sent again in four rounds, before anything is read, is not a flood."""
    assert allowance(10**6, 100, 25) > 4 * (100 // 25 + 2) * 10**6
