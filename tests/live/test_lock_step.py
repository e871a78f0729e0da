"""How a run in lock-step saves wake-ups: deliveries that nobody waits for are gathered, and threads are few."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.live.network.router import Downlink
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.packets import is_barrier, read_delivery
from evedrop.model.slot.records import PacketSlots
from evedrop.system.environment import lock_step_environment
from tests.live.network.test_router import MemoryBench

SHAPE, BATCH = (2, 5), 8


def packets(slots: range, told: bool = False) -> PacketSlots:
    """Any packets of some slots, some of them not sent; told: whether the state is betrayed."""
    z = np.random.default_rng(slots.start).normal(size=(len(slots), *SHAPE))
    sent = (np.add.outer(np.array(slots), np.arange(5)) % 3) > 0
    return PacketSlots(slots.start, np.where(sent[:, None], z, 0.0), None, sent, z + 1.0 if told else None)


def downlink(waited: bool, put: list[bytes], betrayed: int | None = None, message: int = BATCH) -> Downlink:
    """A receiver's link for the slots of a batch; betrayed: the slot whose state is told to it; message: slots of one at most."""
    brief = MemoryBench().brief
    brief = replace(brief, flow=replace(brief.flow, message=message))
    if betrayed is not None:
        brief = replace(brief, part=replace(brief.part, leaks={"eve": betrayed}))
    link = Downlink("eve", brief.part.links["eve"], brief, lambda payload, _: put.append(payload), waited)
    link.core.plan(range(BATCH))
    return link


def contents(put: list[bytes]) -> list[tuple[int, int]]:
    """First slot and number of slots of each delivery; 0 slots for a barrier."""
    messages = [Reader("d", payload) for payload in put]
    return [(message.integer("k"), 0 if is_barrier(message) else message.integer("c")) for message in messages]


def test_deliveries_that_nobody_waits_for_are_sent_as_one_message() -> None:
    """Nothing before the end of the batch, then all of it, with the packets of single messages; and nothing twice."""
    together, alone = list[bytes](), list[bytes]()
    for put, waited in ((together, False), (alone, True)):
        link = downlink(waited, put)
        for slots in (range(2), range(2, 3), range(3, 7)):
            link.take(packets(slots))
        assert bool(put) == waited
        link.flush()
        link.flush()
    assert contents(together) == [(0, 7)]
    assert contents(alone) == [(0, 2), (2, 1), (3, 4)]
    whole = read_delivery(Reader("d", together[0]), 0, SHAPE, most=BATCH)
    for payload, (k, c) in zip(alone, contents(alone), strict=True):
        part = read_delivery(Reader("d", payload), k, SHAPE, most=BATCH)
        assert np.array_equal(part.gamma, whole.gamma[k : k + c])
        assert part.z.tobytes() == whole.z[k : k + c].tobytes()


@pytest.mark.parametrize(("message", "expected"), [(1, [1] * 5), (2, [2, 2, 1]), (3, [3, 2])])
def test_a_message_carries_no_more_slots_than_the_run_allows(message: int, expected: list[int]) -> None:
    """Its size is bounded by that number."""
    put: list[bytes] = []
    link = downlink(False, put, message=message)
    for k in range(5):
        link.take(packets(range(k, k + 1)))
    link.flush()
    assert [c for _, c in contents(put)] == expected


def test_they_are_sent_before_a_barrier() -> None:
    """The receiver reports all slots below the barrier."""
    put: list[bytes] = []
    link = downlink(False, put)
    link.take(packets(range(3)))
    link.flush()
    link.mark(3)
    link.take(packets(range(3, 5)))
    link.flush()
    assert contents(put) == [(0, 3), (3, 0), (3, 2)]


def test_the_slot_of_a_betrayed_state_has_a_message_of_its_own() -> None:
    """What is held is sent before it, and nothing is held with it."""
    put: list[bytes] = []
    link = downlink(False, put, betrayed=4)
    for slots in (range(4), range(4, 5), range(5, 7)):
        link.take(packets(slots, slots.start == 4))
    assert contents(put) == [(0, 4), (4, 1)]
    link.flush()
    assert contents(put)[2:] == [(5, 2)]
    told = [Reader("d", payload).has("truth") for payload in put]
    assert told == [False, True, False]
    truth = read_delivery(Reader("d", put[1]), 4, SHAPE).truth[0]
    state = packets(range(4, 5), True).truth
    assert state is not None
    assert np.array_equal(truth, state[0])


def test_what_is_held_may_be_silent_in_some_slots_only() -> None:
    """A scheme may say in some slots only that nothing was sent."""
    put: list[bytes] = []
    link = downlink(False, put)
    link.take(packets(range(2)))
    link.take(replace(packets(range(2, 4)), sent=None))
    link.flush()
    assert contents(put) == [(0, 4)]


@pytest.mark.parametrize("role", ["router", "relay", "sensor", "controller"])
def test_nobody_who_passes_messages_on_does_it_on_the_thread_that_receives(role: str) -> None:
    """A router or relay that waited for a full queue on its only thread would wait for itself, until it is given up."""
    result: dict[str, Any] = lock_step_environment(role)
    assert ("tx: (worker_threads: 1)" in result["ZENOH_RUNTIME"]) == (role in {"router", "relay"})
