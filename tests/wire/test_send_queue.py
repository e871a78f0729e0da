"""What waits for its turn at a side: in order, in a limited number, and with a fate in the journal whatever becomes of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop.system.world import world
from evedrop.wire.journal import WireJournal
from evedrop.wire.records import HELD, Kind, WireFate, records_in
from evedrop.wire.send_queue import SendQueue
from tests.conftest import LIMIT, wait_until
from tests.wire.wire_at_work import both_ways

LONG = 1000.0


class Queue:
    """The queue of a side, whose programs take messages when the test lets them."""

    def __init__(self, folder: Path, **limits: Any) -> None:
        plan = both_ways(held_messages=limits.pop("held_messages", 100))
        self.folder, self.journal = folder, WireJournal(folder, plan).begin()
        self.told: list[str] = []
        self.sent: list[int] = []
        self.lost: list[int] = []
        self.send_queue = SendQueue("base", plan, self.journal.records, self.told.append, **limits)
        self._takes = threading.Semaphore(0)
        self._count = 0

    def give(self, size: int = 1, patient: bool = False, delay: float = 0.0) -> int:
        """Send a message; returns its row."""
        n, self._count = self._count, self._count + 1
        code = self.journal.words.key_code("scan")
        row = self.journal.records.record(
            time.time(), n, -1, delay, code, 0, size, 0, Kind.PUT, WireFate.DELIVERED | HELD
        )

        def task() -> None:
            if not self._takes.acquire(timeout=LIMIT):
                raise TimeoutError
            self.sent.append(n)

        self.send_queue.send(delay, size, row, task, patient=patient, lost=lambda: self.lost.append(n))
        return row

    def takes(self, count: int) -> None:
        """Let the side take messages."""
        for _ in range(count):
            self._takes.release()

    def fates(self, killed: bool = False) -> list[WireFate]:
        """The fates on the disk. killed: as they are if the process were killed now."""
        rows = records_in(self.folder / "journal" / "unfinished" / "001-0001.rows", killed)
        return [WireFate(fate) for fate in rows["fate"].tolist()]


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[Queue]:
    """A queue of three messages and 100 bytes; nobody waits for it long."""
    made = Queue(tmp_path, most=3, most_bytes=100, patience=0.05)
    yield made
    made.takes(100)
    made.send_queue.end()
    made.send_queue.close(time.monotonic() + LIMIT)
    made.journal.close()


def busy(queue: Queue) -> None:
    """Return when the side's thread has a message in its hands."""
    queue.give()
    wait_until(lambda: queue.send_queue._duty.in_hand is not None, "a message is being sent")


def test_messages_are_sent_in_order_and_a_killed_wire_knows_which_were(queue: Queue) -> None:
    """Until a message is sent, its row says on the disk that it is not."""
    busy(queue)
    for _ in range(3):
        queue.give()
    assert queue.fates() == [WireFate.DELIVERED] * 4
    assert queue.fates(killed=True) == [WireFate.UNDERWAY] * 4
    queue.takes(2)
    wait_until(lambda: queue.fates(killed=True)[1] is WireFate.DELIVERED, "two are sent")
    assert queue.fates(killed=True) == [WireFate.DELIVERED] * 2 + [WireFate.UNDERWAY] * 2
    queue.takes(2)
    wait_until(lambda: queue.send_queue.is_free, "all are sent")
    assert queue.sent == [0, 1, 2, 3]
    assert queue.fates(killed=True) == [WireFate.DELIVERED] * 4


def test_no_message_goes_past_a_message_that_is_being_sent(queue: Queue) -> None:
    """Or else it would overtake it: nothing else waits any more."""
    assert queue.send_queue.is_free
    busy(queue)
    assert not queue.send_queue.is_free
    queue.takes(1)
    wait_until(lambda: queue.send_queue.is_free, "it is sent")
    assert queue.sent == [0]


def test_a_message_that_does_not_wait_is_congested_when_there_is_no_room(queue: Queue) -> None:
    """A number of messages, and a number of bytes; but one message may be larger."""
    busy(queue)
    for _ in range(4):
        queue.give()
    assert queue.fates() == [WireFate.DELIVERED] * 4 + [WireFate.CONGESTED]
    assert queue.lost == [4]
    queue.takes(4)
    wait_until(lambda: queue.send_queue.is_free, "all are sent")
    queue.give(size=1000)
    queue.give(size=1)
    assert queue.lost == [4, 6]
    assert queue.told == []


def test_a_message_that_waits_gets_the_room_that_is_made(tmp_path: Path) -> None:
    """And its sender waits until then."""
    queue = Queue(tmp_path, most=3, patience=LONG)
    busy(queue)
    for _ in range(3):
        queue.give()
    sender = threading.Thread(target=queue.give, kwargs={"patient": True})
    sender.start()
    wait_until(lambda: queue.send_queue._watched, "it waits")
    assert sender.is_alive()
    queue.takes(1)
    sender.join(LIMIT)
    assert not sender.is_alive()
    queue.takes(4)
    wait_until(lambda: queue.sent == [0, 1, 2, 3, 4], "all are sent")
    assert queue.told == []
    queue.send_queue.end()
    queue.send_queue.close(time.monotonic() + LIMIT)
    queue.journal.close()


def test_nobody_waits_for_a_side_that_has_stopped(queue: Queue) -> None:
    """From the first time that it takes nothing until half of its queue is free: each is told once."""
    busy(queue)
    for _ in range(6):
        queue.give(patient=True)
    assert queue.lost == [4, 5, 6]
    assert len(queue.told) == 1
    assert "programs at the side base have stopped reading, or read very slowly" in queue.told[0]
    queue.takes(1)
    wait_until(lambda: len(queue.send_queue._queue) == 3, "one is taken")
    queue.give(patient=True)
    queue.give(patient=True)
    assert queue.lost == [4, 5, 6, 8]
    queue.takes(4)
    wait_until(lambda: len(queue.told) == 2, "it takes messages again")
    assert queue.told[1] == "the side base takes messages again"
    assert queue.send_queue._trust == 0.5
    wait_until(lambda: queue.send_queue.is_free, "all are sent")
    assert queue.sent == [0, 1, 2, 3, 7]


def test_a_delayed_message_is_held_up_or_congested(tmp_path: Path) -> None:
    """By the limit of what is delayed when it comes, or by that of the side when its delay is over."""
    queue = Queue(tmp_path, most=1, patience=LONG, held_messages=2)
    busy(queue)
    queue.give()
    queue.give(delay=1e-3)
    wait_until(lambda: queue.lost == [2], "there is no room at the side")
    for _ in range(3):
        queue.give(delay=LONG)
    assert queue.lost == [2, 5]
    assert queue.fates()[2:] == [WireFate.CONGESTED, WireFate.DELIVERED, WireFate.DELIVERED, WireFate.HELD_UP]
    queue.takes(2)
    queue.send_queue.end()
    queue.send_queue.close(time.monotonic() + LIMIT)
    assert queue.fates() == [WireFate.DELIVERED] * 2 + [
        WireFate.CONGESTED, WireFate.UNDERWAY, WireFate.UNDERWAY, WireFate.HELD_UP
    ]  # fmt: skip
    queue.journal.close()


def test_an_error_stops_one_message_only(queue: Queue) -> None:
    """What must follow is carried out in its turn."""
    code, order = queue.journal.words.key_code("scan"), list[str]()
    row = queue.journal.records.record(time.time(), 0, -1, 0.0, code, 0, 1, 0, Kind.PUT, WireFate.DELIVERED | HELD)
    queue.send_queue.send(0.0, 1, row, lambda: 1 / 0, patient=False)
    queue.send_queue.follow(lambda: 1 / 0)
    queue.give()
    queue.send_queue.follow(lambda: order.append("last"))
    queue.takes(1)
    wait_until(lambda: order, "it is carried out")
    assert queue.sent == [0]
    assert queue.fates() == [WireFate.REFUSED, WireFate.DELIVERED]


def test_the_end_does_not_wait_for_a_side_that_takes_nothing(tmp_path: Path) -> None:
    """What it did not take is under way, also what waited for room."""
    queue = Queue(tmp_path, most=2, patience=LONG)
    busy(queue)
    queue.give()
    queue.give()
    sender = threading.Thread(target=queue.give, kwargs={"patient": True})
    sender.start()
    wait_until(lambda: queue.send_queue._watched, "it waits")
    queue.send_queue.end()
    sender.join(LIMIT)
    assert queue.lost == [3]
    queue.send_queue.close(time.monotonic())
    assert queue.fates() == [WireFate.UNDERWAY] * 4
    queue.takes(10)
    queue.send_queue._thread.join(LIMIT)
    assert not queue.send_queue._thread.is_alive()
    assert queue.sent == [0]
    queue.journal.close()


def test_the_end_is_not_missed_by_a_message_that_is_about_to_wait(queue: Queue) -> None:
    """Room is made, and the end told, only while no message looks for room: between its look and its wait it would miss it."""
    send_queue, safe = queue.send_queue, list[bool]()

    class Room(threading.Event):
        def set(self) -> None:
            free = send_queue._lock.acquire(blocking=False)
            if free:
                send_queue._lock.release()
            safe.append(not free)
            super().set()

    send_queue._room = Room()
    busy(queue)
    for _ in range(4):
        queue.give(patient=True)
    queue.takes(4)
    wait_until(lambda: len(safe) == 1, "room is made")
    send_queue.end()
    assert safe == [True, True]


def test_two_senders_that_wait_are_told_once(queue: Queue) -> None:
    """And both go on; the patience is halved once."""
    busy(queue)
    for _ in range(3):
        queue.give()
    senders = [threading.Thread(target=queue.give, kwargs={"patient": True}) for _ in range(2)]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join(LIMIT)
    assert sorted(queue.lost) == [4, 5]
    assert len(queue.told) == 1
    assert queue.send_queue._trust == 0.5


def test_a_message_that_comes_after_the_end_is_under_way(tmp_path: Path) -> None:
    """Such as a reply to a query, which Zenoh may bring until the sessions are closed."""
    queue = Queue(tmp_path)
    queue.send_queue.end()
    queue.send_queue.close(time.monotonic() + LIMIT)
    queue.give(patient=True)
    queue.give(delay=LONG)
    queue.send_queue.follow(lambda: queue.sent.append(-1))
    assert queue.lost == [0, 1]
    assert queue.fates() == [WireFate.UNDERWAY, WireFate.UNDERWAY]
    assert queue.sent == []
    queue.journal.close()


@pytest.mark.parametrize(
    ("alone", "waits", "free"),
    [
        (True, [0.9, 0.9, 0.9], True),
        (True, [1.1], False),
        (False, [0.01] * 4, True),
        (False, [0.01] * 6, False),
        (False, [0.01] * 4 + [None] + [0.01] * 4, True),
    ],
)
def test_a_side_that_lets_others_wait_has_no_messages_past_the_queue(
    queue: Queue, monkeypatch: pytest.MonkeyPatch, alone: bool, waits: list[float | None], free: bool
) -> None:
    """A long wait of a sender that sends to no other side, or waits for more than a tenth of the time; None is a pause."""
    now = [1000.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])
    for seconds in waits:
        if seconds is None:
            now[0] += 10.0
        else:
            now[0] += seconds
            queue.send_queue.took(seconds, alone)
    assert queue.send_queue.is_free == free


def test_a_side_that_was_slow_has_messages_past_the_queue_again(queue: Queue, monkeypatch: pytest.MonkeyPatch) -> None:
    """After some seconds, and each time after twice as many."""
    now = [1000.0]
    monkeypatch.setattr(world(), "monotonic", lambda: now[0])

    def is_free_after(seconds: float) -> bool:
        now[0] += seconds
        queue.give()
        queue.takes(1)
        wait_until(lambda: queue.send_queue._sleeps, "it is sent")
        return queue.send_queue.is_free

    queue.send_queue.took(2.0, alone=True)
    assert [is_free_after(seconds) for seconds in (9.0, 2.0)] == [False, True]
    queue.send_queue.took(2.0, alone=True)
    assert [is_free_after(seconds) for seconds in (19.0, 2.0)] == [False, True]
