"""What the wire sends at a side. Each side has a thread of its own, so that a reader that stops holds up nobody at another side.

A program that no longer reads lets Zenoh wait, up to 5 seconds for each message that must not be dropped. So what is heard at one
side waits in a queue for its turn at another one. If the queue is full, messages over a link wait for room, and with them
their sender, as `CongestionControl.BLOCK` asks for; but not for a side that takes almost nothing. Copies over a tap never wait.

Source: docs/wire/semantics.md, programs that stop reading.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, final

from evedrop.system.world import world
from evedrop.wire.journal_records import JournalRecords
from evedrop.wire.plan import WirePlan
from evedrop.wire.records import WireFate
from evedrop.wire.running_link import KeyOrder, Scheduler
from evedrop.wire.watchdog import Duty

MOST_WAITING: Final = 8192
"""Messages that may wait for their turn at a side."""
MOST_BYTES: Final = 2**26
"""Their bytes, as `waiting_bytes`, unless it is a single message."""
MESSAGE_BYTES: Final = 1024
"""Bytes that a message takes besides its key, payload and attachment."""
PATIENCE: Final = 2.0
"""Seconds in which a side must take some of a full queue, or else nobody waits for it any more; each time half as many."""
LONG_SECONDS: Final = 2e-4
"""Seconds after which a message that was sent past the queue took long."""
LAST_SECONDS: Final = 2.0
"""Seconds that the sides have to take what waits when the wire ends."""
_ALONE_SECONDS = 1.0  # that a message may take past the queue if no third side waits with it
_FRACTION, _MOST_SECONDS = 0.1, 0.05  # of the time, and seconds at a time, for which a side may let others wait
_SLOW_SECONDS = 10.0  # for which a slow side has no messages past the queue; each time twice as long
_TICK = 0.05  # of the patience, which counts ticks: a process that was suspended has not waited
_SLOW = 2.0**24  # bytes that a side takes in a second at least, or it counts as stopped
_PART = 32  # of a full queue: so much of it must become free before those who wait go on
_NO_ROW = -1

Task = Callable[[], object]


def waiting_bytes(size: int, key: str) -> int:
    """How many bytes a message takes while it waits. size: of its payload and attachment, in bytes."""
    return size + len(key) + MESSAGE_BYTES


@final
class SendQueue:
    """Sends at a side, in the order in which it is given messages. Threads may call its methods at the same time."""

    def __init__(
        self,
        side: str,
        plan: WirePlan,
        records: JournalRecords,
        tell: Callable[[str], None],
        *,
        most: int = MOST_WAITING,
        most_bytes: int = MOST_BYTES,
        patience: float = PATIENCE,
    ) -> None:
        """tell: for what the user must know; most, most_bytes: how much may wait; patience: in seconds."""
        self._side, self._records, self._tell = side, records, tell
        self._most, self._most_bytes, self._patience = most, most_bytes, patience
        self._queue: deque[tuple[int, int, Task]] = deque()
        """What waits, as bytes, row, and task; the first one is being sent."""
        self._given = self._taken = 0  # bytes
        self._lock = world().lock()
        self._bell, self._sleeps = world().lock(), False  # the thread sleeps until the bell is released
        self._bell.acquire(blocking=False)
        self._room = world().event()
        self._watched = False  # whether the queue was full, and room in it must be noticed
        self._stopped = self._ending = self._over = self._ended = False
        self._trust = 1.0  # halved each time: a reader that stops again and again costs others a few seconds in all
        self._is_slow = False
        self._slow_until, self._slow_seconds = 0.0, _SLOW_SECONDS
        self._waited, self._noted = 0.0, 0.0  # for how many seconds others waited lately, as of a time
        self._delays = Scheduler(plan.held_messages, plan.held_bytes, self._refused)
        self._duty = Duty(f"in what is sent at the side {side}")
        self.duties = (self._delays.duty, self._duty)
        self._thread = world().thread(self._run, name=f"to {side}")
        self._thread.start()

    def send(
        self,
        delay: float,
        size: int,
        row: int,
        task: Task,
        *,
        patient: bool,
        order: KeyOrder | None = None,
        lost: Callable[[], None] | None = None,
        since: float | None = None,
    ) -> None:
        """Send a message, by a task, after some seconds. Its row in the journal is `HELD`.

        size: as `waiting_bytes`; patient: whether to wait for room; order: that it must keep; lost: is called if there is no
        room; since: as for `Scheduler.hold`.

        A message for which there is no room becomes `HELD_UP` if it is delayed, or else `CONGESTED`; one whose task raises an
        error becomes `REFUSED`.
        """
        if not delay and order is None:
            self._hand(size, row, task, patient, lost)
        elif not self._delays.hold(delay, size, row, lambda: self._hand(size, row, task, patient, lost), order, since):
            self._records.amend(row, WireFate.UNDERWAY if self._ending else WireFate.HELD_UP)
            if lost is not None:
                lost()

    @property
    def is_free(self) -> bool:
        """Whether a message may be sent past the queue: nothing waits in it or is being sent, and the side is not slow."""
        return not (self._queue or self._is_slow)

    @property
    def waiting(self) -> int:
        """How many messages wait for their turn, with the one that is being sent."""
        return len(self._queue)

    def took(self, seconds: float, alone: bool) -> None:
        """Note that a message took longer than `LONG_SECONDS` past the queue. alone: whether no third side waited meanwhile."""
        now = world().monotonic()
        with self._lock:
            if not alone:
                self._waited = max(0.0, self._waited - _FRACTION * (now - self._noted)) + seconds
                self._noted = now
            if not self._is_slow and (seconds > _ALONE_SECONDS if alone else self._waited > _MOST_SECONDS):
                self._is_slow = True
                self._slow_until, self._slow_seconds = now + self._slow_seconds, 2.0 * self._slow_seconds

    def follow(self, task: Task) -> None:
        """Carry out a task after all that was handed over so far, even if there is no room."""
        with self._lock:
            self._put(0, _NO_ROW, task)

    def end(self) -> None:
        """Send no more delayed messages, and end when what waits has been sent."""
        with self._lock:  # or else a message that is about to wait for room would miss this
            self._ending = True
            self._room.set()
        for row in self._delays.close():
            self._records.amend(row, WireFate.UNDERWAY)
        with self._lock:
            self._over = True
            self._wake()

    def close(self, deadline: float) -> None:
        """Wait for the end, until a time; what is not sent by then is `UNDERWAY`."""
        self._thread.join(max(0.0, deadline - world().monotonic()))
        with self._lock:
            self._ended = True
            for _, row, _ in self._queue:
                if row != _NO_ROW:
                    self._records.amend(row, WireFate.UNDERWAY)

    def _put(self, size: int, row: int, task: Task) -> None:
        """Add to the queue. The lock is held."""
        self._given += size
        self._queue.append((size, row, task))
        self._wake()

    def _wake(self) -> None:
        """Let the thread look at the queue. The lock is held."""
        if self._sleeps:
            self._sleeps = False
            self._bell.release()

    def _hand(self, size: int, row: int, task: Task, patient: bool, lost: Callable[[], None] | None) -> None:
        """Let a message wait for its turn, if there is room."""
        while True:
            with self._lock:
                waiting = self._given - self._taken
                if self._ended:
                    break
                if len(self._queue) <= self._most and (not waiting or waiting + size <= self._most_bytes):
                    self._put(size, row, task)
                    return
                self._watched = True
                if not patient or self._stopped or self._ending:
                    break
                self._room.clear()
                trust = self._trust
            if not self._gets_room(trust * (self._patience + waiting / _SLOW)):
                self._stop()
        self._records.amend(row, WireFate.UNDERWAY if self._ending else WireFate.CONGESTED)
        if lost is not None:
            lost()

    def _gets_room(self, seconds: float) -> bool:
        """Wait for some seconds, or until room is made; returns whether it was."""
        return any(self._room.wait(min(seconds, _TICK)) for _ in range(max(1, round(seconds / _TICK))))

    def _has_room(self, part: int) -> bool:
        """Whether a part of the queue, 1/`part`, is free."""
        waiting = self._given - self._taken
        return (
            len(self._queue) <= self._most - self._most // part
            and waiting <= self._most_bytes - self._most_bytes // part
        )

    def _stop(self) -> None:
        """Note that the side takes almost nothing."""
        with self._lock:
            if self._stopped or self._ending or self._room.is_set():
                return  # noted by another thread, or just over
            self._stopped = True
            self._trust /= 2.0
        self._tell(
            f"programs at the side {self._side} have stopped reading, or read very slowly: until they go on, messages to it for "
            "which there is no room are dropped as congested"
        )

    def _refused(self, row: int) -> None:
        self._records.amend(row, WireFate.REFUSED)

    def _run(self) -> None:
        queue, lock, sent = self._queue, self._lock, self._records.sent
        while queue or self._wait():
            item = queue[0]
            size, row, task = item
            self._duty.in_hand = item
            try:
                task()
                failed = False
            except Exception:  # whatever it is: the next message must be sent
                failed = True
            with lock:
                if self._ended:
                    break  # `close` has said what became of it
                if row != _NO_ROW:
                    if failed:
                        self._refused(row)
                    else:
                        sent(row)
                queue.popleft()
                self._taken += size
            self._duty.in_hand = None
            if self._watched and self._has_room(_PART):
                self._go_on()
        self._duty.in_hand = None

    def _wait(self) -> bool:
        """Wait for a message; returns whether there is one, and not the end."""
        with self._lock:
            self._is_slow = self._is_slow and world().monotonic() < self._slow_until
            self._sleeps = not (self._queue or self._over)
            sleeps = self._sleeps
        if sleeps:
            self._bell.acquire()
        return bool(self._queue)

    def _go_on(self) -> None:
        """Let those who wait for room go on; and if they no longer wait, let them as soon as half of the queue is free."""
        with self._lock:
            again = self._stopped
            if not self._has_room(2 if again else _PART):
                return
            self._watched = self._stopped = False
            self._room.set()
        if again:
            self._tell(f"the side {self._side} takes messages again")
