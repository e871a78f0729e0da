"""A router on a session in memory: barriers, changed links, absent receivers, acknowledgements, and rounds of resending."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.launch.briefs import history_of
from evedrop.live.network.router import RouterLoop
from evedrop.live.protocol import packets, telemetry
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import Again, EndRun, Go, LinkChange
from evedrop.live.protocol.record_messages import packed
from evedrop.model.links.loss_model import REASONS
from evedrop.model.slot.link import Change
from evedrop.model.slot.records import PacketSlots
from tests.conftest import LIMIT, wait_until
from tests.live.network.test_router import Ear, MemoryBench
from tests.messages import packet

SLOTS, BATCH = 96, 8
SHAPE = (2, 5)
LATE: dict[str, Any] = {
    "slots": SLOTS,
    "legitimate": {
        "window": 3,
        "link": {
            "quality": 0.7,
            "duplicate": 0.3,
            "delay": {"model": "normal", "mean": 0.5, "standard_deviation": 1.5},
        },
    },
    "eavesdroppers": {"eve": {"strategy": "smart", "link": {"quality": 0.05}}},
}
"""Packets that come late, twice and too late on one link; on the other, losses in longer runs than a batch."""
WINDOWS = {"legitimate": 3, "eve": 0}


def send(bench: MemoryBench, slots: range) -> None:
    """Have the sensor send the packets of these slots."""
    for k in slots:
        bench.put("sensor", bench.keys.uplink, packet(k, bench.packet(k)))


def announce(bench: MemoryBench, number: int, done: int, first: int) -> None:
    """Have the sensor announce that it sends its packets again."""
    bench.put("sensor", bench.keys.uplink, packets.resend(number, done, first))


def deliveries(bench: MemoryBench, slots: range) -> dict[str, list[bytes]]:
    """The next deliveries to each receiver, which must be of these slots."""
    heard = {name: [ear.hear()[1] for _ in slots] for name, ear in bench.downlinks.items()}
    for name, payloads in heard.items():
        assert [Reader(name, payload).integer("k") for payload in payloads] == [*slots]
    return heard


def journals(bench: MemoryBench, start: int, stop: int, windows: Mapping[str, int]) -> dict[int, telemetry.Journal]:
    """First slot → journal, of the next journals, which must cover these slots."""
    heard = {}
    while start < stop:
        message = Reader(*bench.journal.hear())
        heard[start] = telemetry.read_journal(message, start, windows, telemetry.Extent(SLOTS, BATCH, *SHAPE))
        start += heard[start].count
    assert start == stop
    return heard


def same_fates(journal: telemetry.Journal, other: telemetry.Journal, rows: slice) -> None:
    """Check that a journal has some rows of another one."""
    for name, link in journal.links.items():
        whole = other.links[name]
        assert packed(link.slots) == packed(whole.slots.rows(rows))


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("done", [40, 45])
def test_packets_that_are_sent_again_have_the_same_fates(done: int, restarted: bool) -> None:
    """Late and second copies, runs of losses and delays are counted as before, and no slot that is done is told again.

    Whether the router had these slots before, or was started in the place of one that had.
    """
    with MemoryBench(**LATE) as bench:
        send(bench, range(SLOTS))
        before = deliveries(bench, range(SLOTS))
        wanted = journals(bench, 0, SLOTS, WINDOWS)
        assert any(
            packets.read_delivery(Reader("d", payload), k, SHAPE).late for k, payload in enumerate(before["legitimate"])
        )
        if not restarted:
            check_round(bench, done, before, wanted)
    if restarted:
        with MemoryBench(**LATE) as other:
            check_round(other, done, before, wanted)


def check_round(
    bench: MemoryBench, done: int, before: Mapping[str, list[bytes]], wanted: Mapping[int, telemetry.Journal]
) -> None:
    """Check what a router delivers and journals in a round, against what it did the first time."""
    bench.stage.commands.put(Again(1, done, {}).pack())
    first = done - WINDOWS["legitimate"]
    announce(bench, 1, done, first)
    send(bench, range(first, SLOTS))
    assert deliveries(bench, range(done, SLOTS)) == {name: all_of[done:] for name, all_of in before.items()}
    journaled = journals(bench, done, SLOTS, WINDOWS)
    for start, journal in journaled.items():
        if start in wanted:
            assert journal.pack() == wanted[start].pack()
        else:  # the first slot that is not done is in the middle of a batch
            batch = start - start % BATCH
            same_fates(journal, wanted[batch], slice(start - batch, BATCH))
    assert any(link.bursts[BATCH:].any() for journal in journaled.values() for link in journal.links.values())


def test_a_router_says_how_far_it_has_decided_the_fates_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """With many slots and trials that takes longer than a process may be silent."""
    said, plan = [], RouterLoop._plan

    def planned(loop: RouterLoop, first: int) -> range:
        said.append((first, loop._session.status.slot))
        return plan(loop, first)

    monkeypatch.setattr(RouterLoop, "_plan", planned)
    with MemoryBench(**LATE) as bench:
        send(bench, range(SLOTS))
        deliveries(bench, range(SLOTS))
        bench.stage.commands.put(Again(1, 60, {}).pack())
        announce(bench, 1, 60, 57)
        send(bench, range(57, SLOTS))
        deliveries(bench, range(60, SLOTS))
    assert len(said) > SLOTS // BATCH + 57 // BATCH
    assert all(first == slot for first, slot in said)


def send_blocks(bench: MemoryBench, slots: range, count: int) -> None:
    """Have the sensor send the packets of these slots, `count` in a message; a batch begins a new message."""
    k = slots.start
    while k < slots.stop:
        end = min(k + count, k - k % BATCH + BATCH, slots.stop)
        z = np.array([bench.packet(slot) for slot in range(k, end)])
        bench.put("sensor", bench.keys.uplink, packets.uplink(PacketSlots(k, z)))
        k = end


def received(payloads: list[bytes], first: int) -> list[tuple[bytes, bytes, list[tuple[int, bytes]]]]:
    """The γ, z and late packets of each slot, from deliveries that may have several slots."""
    slots: list[tuple[bytes, bytes, list[tuple[int, bytes]]]] = []
    for payload in payloads:
        arrivals = packets.read_delivery(Reader("d", payload), first + len(slots), SHAPE, window=3, most=BATCH)
        for row in range(len(arrivals.gamma)):
            heard, late = arrivals.at(row)
            slots.append(
                (heard.gamma.tobytes(), heard.z.tobytes(), [(part.k, part.heard.z.tobytes()) for part in late])
            )
    return slots


def deliveries_from(ear: Ear, first: int, stop: int) -> tuple[list[int], list[bytes]]:
    """The first slots of the next deliveries, and the deliveries, which must cover these slots."""
    starts, payloads = [], []
    while first < stop:
        key, payload = ear.hear()
        message = Reader(key, payload)
        assert message.integer("k") == first
        starts.append(first)
        payloads.append(payload)
        first += message.integer("c")
    assert first == stop
    return starts, payloads


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize(("done", "count"), [(40, 3), (43, 8), (45, 3), (45, 8), (47, 7)])
def test_a_message_is_split_at_the_first_slot_that_is_not_done(done: int, count: int, restarted: bool) -> None:
    """Its slots that are done are counted and not delivered again; the others are delivered and journaled as before."""
    with MemoryBench(**LATE) as single:
        send(single, range(SLOTS))
        wanted = {name: received(payloads, 0) for name, payloads in deliveries(single, range(SLOTS)).items()}
        fates = journals(single, 0, SLOTS, WINDOWS)
    with MemoryBench(**LATE) as bench:
        if not restarted:
            send_blocks(bench, range(SLOTS), count)
            for name, ear in bench.downlinks.items():
                assert received(deliveries_from(ear, 0, SLOTS)[1], 0) == wanted[name]
            for start, journal in journals(bench, 0, SLOTS, WINDOWS).items():
                assert journal.pack() == fates[start].pack()
        first = done - WINDOWS["legitimate"]
        first -= (first % BATCH) % count  # the first slot of its message
        bench.stage.commands.put(Again(1, done, {}).pack())
        announce(bench, 1, done, first)
        send_blocks(bench, range(first, SLOTS), count)
        for name, ear in bench.downlinks.items():
            starts, payloads = deliveries_from(ear, done, SLOTS)
            assert starts[0] == done
            assert len(starts) < SLOTS - done
            assert received(payloads, done) == wanted[name][done:]
        for start, journal in journals(bench, done, SLOTS, WINDOWS).items():
            batch = start - start % BATCH
            same_fates(journal, fates[batch], slice(start - batch, BATCH))


def test_packets_before_a_round_that_the_conductor_wants_are_ignored() -> None:
    """The sensor's answer to an earlier request comes first: nothing of it is delivered, not even the slot that is due."""
    with MemoryBench(**LATE) as bench:
        send(bench, range(20))
        before = deliveries(bench, range(20))
        bench.stage.commands.put(Again(2, 16, {}).pack())
        announce(bench, 1, 8, 5)
        send(bench, range(5, 24))
        announce(bench, 2, 16, 13)
        send(bench, range(13, 20))
        assert deliveries(bench, range(16, 20)) == {name: some[16:] for name, some in before.items()}
        send(bench, range(20, 21))
        deliveries(bench, range(20, 21))


def test_a_round_that_the_sensor_announces_first_begins_as_soon_as_the_conductor_asks_for_it() -> None:
    """The router waits for the command, and no longer than it takes to come."""
    with MemoryBench(**LATE, longest_outage=100.0 * LIMIT) as bench:
        send(bench, range(16))
        before = deliveries(bench, range(16))
        announce(bench, 1, 8, 5)
        wait_until(bench.stage.queues[bench.keys.uplink].empty, "a router that has read the announcement")
        bench.stage.commands.put(Again(1, 8, {}).pack())
        send(bench, range(5, 16))
        assert deliveries(bench, range(8, 16)) == {name: some[8:] for name, some in before.items()}


def test_a_malformed_command_ends_the_router() -> None:
    """With the error that says so, although its thread for packets has nothing to do."""
    bench = MemoryBench(**LATE)
    loop = RouterLoop(bench.brief, bench.stage.session(bench.brief))
    bench.stage.commands.put(b"\xc1")
    with pytest.raises(MalformedMessage, match="control/router: not msgpack"):
        loop.carry_on()


TRUE = {"loss": {"model": "bernoulli", "quality": True}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Change(12, TRUE), "quality is true; expected a number from 0 to 1"),
        (Change(12, {"loss": {}}), r"invalid settings \(KeyError\('model'\)\)"),
        (Change(11, cut=True), "a change before the hold; expected slots from 12 on"),
    ],
)
def test_a_wrong_change_of_a_link_ends_the_router(change: Change, message: str) -> None:
    """Rather than that the link is another one than the operator asked for."""
    bench = MemoryBench(**LATE)
    loop = RouterLoop(bench.brief, bench.stage.session(bench.brief))
    send(bench, range(12))
    bench.put("sensor", bench.keys.uplink, packets.barrier(12))
    bench.stage.commands.put(LinkChange("eve", (change,)).pack())
    with pytest.raises(MalformedMessage, match=message):
        loop.carry_on()
    bench.stage.commands.put(EndRun().pack())


def test_a_wrong_change_that_is_told_again_ends_the_router() -> None:
    """One that was started in the place of another is told of all changes so far."""
    bench = MemoryBench(**LATE)
    loop = RouterLoop(bench.brief, bench.stage.session(bench.brief))
    bench.stage.commands.put(Again(1, 0, {"eve": (Change(12, TRUE),)}).pack())
    announce(bench, 1, 0, 0)
    with pytest.raises(MalformedMessage, match="quality is true"):
        loop.carry_on()
    bench.stage.commands.put(EndRun().pack())


def test_a_packet_without_the_state_that_is_betrayed_ends_the_router() -> None:
    """In the slot in which an eavesdropper is told; in all others, packets have none."""
    eve = {"strategy": "replay-informed", "reads_as": "smart", "learns_at": 3, "link": {"quality": 1.0}}
    bench = MemoryBench(**{**LATE, "eavesdroppers": {"eve": eve}})
    loop = RouterLoop(bench.brief, bench.stage.session(bench.brief))
    send(bench, range(4))
    with pytest.raises(MalformedMessage, match="no truth; expected truth, the state of slot 3, which is betrayed"):
        loop.carry_on()
    bench.stage.commands.put(EndRun().pack())


@pytest.mark.parametrize("kept", [True, False])
def test_a_barrier_is_passed_on_and_a_changed_link_is_changed_from_there_on(kept: bool) -> None:
    """All slots before it are delivered and journaled first; nothing follows until the conductor lets the router continue.

    The change holds in a later round, too. kept: for the same router, which knows it; else for one that the conductor tells.
    """
    at, done = 12, 20
    cut = (Change(at, cut=True),)
    with MemoryBench(**LATE) as plain:
        send(plain, range(SLOTS))
        unchanged = deliveries(plain, range(SLOTS))
    with MemoryBench(**LATE) as bench:
        send(bench, range(at))
        bench.put("sensor", bench.keys.uplink, packets.barrier(at))
        send(bench, range(at, 40))
        assert deliveries(bench, range(at)) == {name: some[:at] for name, some in unchanged.items()}
        for name, ear in bench.downlinks.items():
            message = Reader(*ear.hear())
            assert packets.is_barrier(message), name
            assert message.integer("k") == at
        assert [*journals(bench, 0, at, WINDOWS)] == [0, 8]
        assert all(not kept_back for kept_back in bench.heard.values())
        assert bench.stage.put.empty()
        for command in (LinkChange("eve", cut), Go(at - 1), Go(at)):
            bench.stage.commands.put(command.pack())
        after = deliveries(bench, range(at, 40))
        assert after["legitimate"] == unchanged["legitimate"][at:40]
        for k, payload in enumerate(after["eve"], at):
            assert not packets.read_delivery(Reader("d", payload), k, SHAPE).gamma.any()
        wanted = journals(bench, at, 40, WINDOWS)
        assert {int(journal.links["eve"].slots.lost[:, REASONS.index("cut")].min()) for journal in wanted.values()} == {
            5
        }
        if kept:
            check_later(bench, done, {}, after)
    if not kept:
        with MemoryBench(**LATE) as other:
            check_later(other, done, {"eve": cut}, after)


def check_later(
    bench: MemoryBench, done: int, links: dict[str, tuple[Change, ...]], after: Mapping[str, list[bytes]]
) -> None:
    """Check that a round after the change brings the same deliveries."""
    bench.stage.commands.put(Again(1, done, links).pack())
    announce(bench, 1, done, done - 3)
    send(bench, range(done - 3, 40))
    assert deliveries(bench, range(done, 40)) == {name: some[done - 12 :] for name, some in after.items()}


def test_who_is_away_gets_neither_deliveries_nor_barriers() -> None:
    """From the slot in which it leaves to the one in which it is back; its packets are journaled as lost for this reason."""
    away = range(10, 20)
    events = [{"from": away.start, "to": away.stop, "kill": "eve", "state": "last"}]
    eve = {"strategy": "smart", "link": {"quality": 1.0}}
    with MemoryBench(**{**LATE, "eavesdroppers": {"eve": eve}}, event=events) as bench:
        for first, stop in pairwise((0, 10, 15, 20, 24)):
            send(bench, range(first, stop))
            bench.put("sensor", bench.keys.uplink, packets.barrier(stop))
            bench.stage.commands.put(Go(stop).pack())
        heard: dict[str, list[tuple[bool, int]]] = {name: [] for name in bench.downlinks}
        for name, count in (("legitimate", 24 + 4), ("eve", 14 + 2)):
            for _ in range(count):
                message = Reader(*bench.downlinks[name].hear())
                heard[name].append((packets.is_barrier(message), message.integer("k")))
        journaled = journals(bench, 0, 24, WINDOWS)
    marks = {name: [k for barrier, k in all_of if barrier] for name, all_of in heard.items()}
    assert marks == {"legitimate": [10, 15, 20, 24], "eve": [10, 24]}
    slots = {name: [k for barrier, k in all_of if not barrier] for name, all_of in heard.items()}
    assert slots == {"legitimate": [*range(24)], "eve": [*range(10), *range(20, 24)]}
    down = np.concatenate([journal.links["eve"].slots.lost[:, REASONS.index("down")] for journal in journaled.values()])
    assert down.tolist() == [5 if k in away else 0 for k in range(24)]


ACKNOWLEDGED: dict[str, Any] = {
    "slots": SLOTS,
    "legitimate": {"link": {"quality": 0.8}},
    "eavesdroppers": {"eve": {"strategy": "naive", "link": {"quality": 0.4}}},
}
SCHEMES: dict[str, dict[str, Any]] = {
    "never silent": {"scheme": "acknowledged"},
    "silent in some slots": {"scheme": "scheduled", "threshold": 3},
}


def acknowledged(
    bench: MemoryBench, slots: range, done: int = 0
) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Send packets one by one, and acknowledge those that arrive; the slots below `done` are known.

    A scheme without a header is silent in some trials of each slot. Returns slot → the trials in which the legitimate estimator
    received, those in which eve did, and the acknowledgements that come.
    """
    rows, carried = bench.brief.model.header, {}
    for k in slots:
        sent = None if rows else (np.arange(5) + k) % 3 > 0
        header = np.zeros((rows, 5), np.int64) if rows else None
        bench.put("sensor", bench.keys.uplink, packet(k, bench.packet(k), header, sent))
        if k < done:
            continue
        gammas = []
        for name in ("legitimate", "eve"):
            gammas.append(packets.read_delivery(Reader(*bench.downlinks[name].hear()), k, SHAPE, rows).gamma[0])
            assert sent is None or not (gammas[-1] & ~sent).any()
        for slot in (max(k - 1, 0), k):  # one that comes twice is ignored
            bench.stage.callbacks[bench.keys.acknowledged](packets.acknowledgement(slot, gammas[0]))
        arrived = Reader(*Ear(bench, bench.keys.acknowledgements).hear())
        carried[k] = (gammas[0], gammas[1], packets.read_acknowledgement(arrived, k, 5))
    return carried


def channel(attack: str, quality: float) -> dict[str, Any]:
    """The acknowledgements of a scenario, with eve as the jammer where an attack has one."""
    return {"link": {"quality": quality}, "attack": attack, **({} if attack == "none" else {"jammer": "eve"})}


@pytest.mark.parametrize("attack", ["none", "critical"])
def test_acknowledgements_reach_the_sensor_unless_they_are_attacked(attack: str) -> None:
    """Slot by slot those of the legitimate estimator, and under the attack only those of packets that the jammer has, too."""
    tables = {"encoding": SCHEMES["never silent"], "acknowledgements": channel(attack, 1.0)}
    with MemoryBench(**ACKNOWLEDGED, **tables) as bench:
        for legitimate, eve, arrived in acknowledged(bench, range(2 * BATCH)).values():
            assert np.array_equal(arrived, legitimate & (eve | (attack == "none")))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_restarted_router_lets_the_same_acknowledgements_through(scheme: str) -> None:
    """Under a hijack they depend on the packets that the jammer has missed before, which another router has counted."""
    tables = {"encoding": SCHEMES[scheme], "acknowledgements": channel("hijack", 0.8)}
    with MemoryBench(**ACKNOWLEDGED, **tables) as bench:
        before = acknowledged(bench, range(40))
    history = history_of(bench.scenario)
    assert history == (SLOTS if "some" in scheme else 3)
    for done in (9, 20, 32):
        with MemoryBench(**ACKNOWLEDGED, **tables) as other:
            other.stage.commands.put(Again(1, done, {}).pack())
            first = max(0, done - history)
            announce(other, 1, done, first)
            again = acknowledged(other, range(first, 40), done)
        for k, flags in again.items():
            assert all(np.array_equal(*pair) for pair in zip(flags, before[k], strict=True)), (done, k)
