"""Delayed messages: when they are sent, in which order, and how many may wait; by a clock that the test hands in."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

from evedrop.wire.running_link import KeyOrder, Scheduler
from tests.clock import TestClock
from tests.conftest import LIMIT, wait_until


class Held:
    """A scheduler whose thread is busy with a message until it is let go, so that what waits does not depend on threads."""

    def __init__(self, most: int = 100, most_bytes: int = 10_000) -> None:
        self.clock, self.failed = TestClock(), list[int]()
        self.sent: list[tuple[str, float]] = []
        self.scheduler = Scheduler(most, most_bytes, self.failed.append, self.clock)
        self._free = threading.Event()
        begun = threading.Event()

        def busy() -> None:
            begun.set()
            self._free.wait(LIMIT)

        assert self.scheduler.hold(0.0, 0, 0, busy)
        assert begun.wait(LIMIT)

    def hold(self, delay: float, size: int = 1, row: int = 0, name: str = "") -> bool:
        """Hold a message that notes its name and the time at which it is sent."""
        return self.scheduler.hold(delay, size, row, partial(self.note, name))

    def note(self, name: str) -> None:
        """Note that a message is sent now."""
        self.sent.append((name, self.clock.now - 1000.0))

    def let_go(self, until: Callable[[], object]) -> None:
        """Let the thread go on, until a condition holds."""
        self._free.set()
        wait_until(until, "what was held is sent")


def test_messages_are_sent_when_they_are_due() -> None:
    """In the order of their times; those of the same time in the order in which they came."""
    held = Held()
    for delay, name in ((3.0, "a"), (1.0, "b"), (2.5, "c"), (1.0, "d")):
        assert held.hold(delay, name=name)
    assert len(held.scheduler._heap) == 4
    held.let_go(lambda: len(held.sent) == 4)
    assert held.sent == [("b", 1.0), ("d", 1.0), ("c", 2.5), ("a", 3.0)]
    held.hold(0.5, name="e")
    held.let_go(lambda: len(held.sent) == 5)
    assert held.sent[-1] == ("e", 3.5)
    assert len(held.scheduler._heap) == 0
    assert held.scheduler.close() == []


def test_an_order_is_kept() -> None:
    """A message of an order waits for those before it; others do not."""
    held, order = Held(), KeyOrder()
    for delay, name in ((3.0, "a"), (1.0, "b"), (3.5, "c"), (0.0, "d")):
        assert held.scheduler.hold(delay, 1, 0, partial(held.note, name), order)
    held.hold(1.0, name="other")
    held.let_go(lambda: len(held.sent) == 5)
    assert held.sent == [("other", 1.0), ("a", 3.0), ("b", 3.0), ("c", 3.5), ("d", 3.5)]


def test_a_delay_counts_from_when_it_was_decided() -> None:
    """So messages stay in order, however long each took from then until it was held."""
    held = Held()
    start = held.clock.now
    for decided, began, delay, name in ((0.0, 0.5, 2.0, "a"), (0.2, 0.6, 1.9, "b")):
        held.clock.now = start + began
        assert held.scheduler.hold(delay, 1, 0, partial(held.note, name), since=start + decided)
    held.let_go(lambda: len(held.sent) == 2)
    assert [name for name, _ in held.sent] == ["a", "b"]
    held.scheduler.close()


def test_a_limited_number_of_messages_waits() -> None:
    """And a limited number of bytes; what was sent makes room again."""
    held = Held(most=3, most_bytes=100)
    assert held.hold(1.0, size=60)
    assert not held.hold(1.0, size=41)
    assert held.hold(1.0, size=40)
    assert held.hold(1.0, size=0)
    assert not held.hold(1.0, size=0)
    held.let_go(lambda: len(held.sent) == 3)
    assert held.hold(1.0, size=100)
    assert not held.hold(1.0, size=101)
    held.scheduler.close()


def test_what_was_not_sent_at_the_end_is_named() -> None:
    """The rows in the order of their times; nothing is held afterwards."""
    held = Held()
    for delay, row in ((3.0, 1), (1.0, 2), (2.0, 3)):
        held.hold(delay, row=row)
    ended: list[list[int]] = []
    closing = threading.Thread(target=lambda: ended.append(held.scheduler.close()))
    closing.start()
    wait_until(lambda: not held.hold(1.0), "it is ending")
    held.let_go(lambda: ended)
    closing.join()
    assert [row for row in ended[0] if row] == [2, 3, 1]
    assert len(held.scheduler._heap) == 0
    assert held.sent == []


def test_a_message_that_cannot_be_sent_is_named_by_its_row() -> None:
    """And the next ones are sent."""
    held = Held()
    assert held.scheduler.hold(1.0, 1, 7, lambda: 1 / 0)
    held.hold(2.0, name="next")
    held.let_go(lambda: held.sent)
    assert held.failed == [7]
    held.scheduler.close()
