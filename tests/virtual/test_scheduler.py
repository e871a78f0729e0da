"""The scheduler: virtual time, threads that take turns, and processes that end, stand still and go on."""

from __future__ import annotations

import gc
import weakref
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from queue import Empty

import pyarrow as pa
import pytest

from evedrop.virtual.pipes import Pipe
from evedrop.virtual.scheduler import (
    Stuck,
    VirtualCondition,
    VirtualEvent,
    VirtualLock,
    VirtualQueue,
    VirtualScheduler,
    VirtualTask,
    Waiter,
)

SEEDS = range(20)


def started(scheduler: VirtualScheduler, name: str, *works: Callable[[], object]) -> VirtualTask:
    """A process with a thread for each of these."""
    task = scheduler.process(name)
    for work in works:
        scheduler.thread(work.__name__, work, task).start()
    return task


def finish(scheduler: VirtualScheduler, *tasks: VirtualTask, until: float = 1000.0) -> None:
    """Let everything happen until all threads of these processes are over."""
    scheduler.run(until, lambda: all(thread.over for task in tasks for thread in task.threads))


def steps(seed: int) -> tuple[list[str], str]:
    """The order in which three threads take turns, and the hash of what happened."""
    scheduler = VirtualScheduler(seed)
    lock, order = VirtualLock(scheduler), list[str]()

    def work(name: str) -> None:
        for _ in range(20):
            with lock:
                order.append(name)
                scheduler.note("step", name)

    tasks = [started(scheduler, name, lambda name=name: work(name)) for name in "abc"]  # type: ignore[misc]
    finish(scheduler, *tasks)
    return order, scheduler.digest


def test_a_seed_decides_the_order() -> None:
    """The same one gives the same, others give others."""
    assert steps(1) == steps(1)
    assert len({tuple(steps(seed)[0]) for seed in SEEDS}) > 1
    assert len({steps(seed)[1] for seed in SEEDS}) > 1


def test_interruptions_happen() -> None:
    """A thread does not go on for ever: others go on where it takes a lock."""
    order, _ = steps(1)
    changes = sum(one != other for one, other in pairwise(order))
    assert changes > 2


def test_a_lock_excludes_others() -> None:
    """Though its holder waits meanwhile."""
    for seed in SEEDS:
        scheduler = VirtualScheduler(seed)
        lock, inside, most = VirtualLock(scheduler), list[int](), list[int]()

        def work(
            lock: VirtualLock = lock,
            inside: list[int] = inside,
            most: list[int] = most,
            scheduler: VirtualScheduler = scheduler,
        ) -> None:
            with lock:
                inside.append(1)
                scheduler.sleep(0.1)
                most.append(len(inside))
                inside.pop()

        finish(scheduler, started(scheduler, "process", work, work, work))
        assert most == [1, 1, 1]


def test_a_lock_that_another_one_has_is_not_taken_in_time() -> None:
    """Nor without waiting."""
    scheduler = VirtualScheduler(1)
    lock, taken = VirtualLock(scheduler), list[tuple[bool, float]]()

    def hold() -> None:
        with lock:
            scheduler.sleep(10.0)

    def attempt() -> None:
        scheduler.sleep(1.0)
        for timeout in (0.0, 2.0, 100.0):
            taken.append((lock.acquire(timeout=timeout), scheduler.now))

    finish(scheduler, started(scheduler, "process", hold, attempt))
    assert taken == [(False, 1.0), (False, 3.0), (True, 10.0)]


def test_time_passes_only_while_all_wait() -> None:
    """And at once: a day takes no time."""
    scheduler = VirtualScheduler(1)
    seen: list[float] = []

    def work() -> None:
        for seconds in (0.5, 86_400.0):
            scheduler.sleep(seconds)
            seen.append(scheduler.now)

    finish(scheduler, started(scheduler, "process", work), until=1e6)
    assert seen == [0.5, 86_400.5]


def test_waits_end_in_time() -> None:
    """Those for an event, a condition, a queue and a thread."""
    scheduler = VirtualScheduler(1)
    event, condition, queue = VirtualEvent(scheduler), VirtualCondition(scheduler), VirtualQueue(scheduler)
    seen: list[tuple[str, float]] = []

    def sleep() -> None:
        scheduler.sleep(100.0)

    def work() -> None:
        other = scheduler.thread("sleeps", sleep)
        other.start()
        assert not event.wait(1.0)
        seen.append(("event", scheduler.now))
        with condition:
            assert not condition.wait(1.0)
            assert not condition.wait_for(lambda: False, 1.0)
        seen.append(("condition", scheduler.now))
        with pytest.raises(Empty):
            queue.get(timeout=1.0)
        seen.append(("queue", scheduler.now))
        other.join(1.0)
        assert other.is_alive()
        seen.append(("thread", scheduler.now))
        other.join(1000.0)
        assert not other.is_alive()

    task = started(scheduler, "process", work)
    finish(scheduler, task)
    assert scheduler.errors == []
    assert seen == [("event", 1.0), ("condition", 3.0), ("queue", 4.0), ("thread", 5.0)]
    assert scheduler.now == 100.0


def test_who_waits_is_woken_up_by_what_it_waits_for() -> None:
    """Before its limit."""
    for seed in SEEDS:
        scheduler = VirtualScheduler(seed)
        event, condition, queue = VirtualEvent(scheduler), VirtualCondition(scheduler), VirtualQueue(scheduler)
        got: list[object] = []

        def take(
            event: VirtualEvent = event,
            condition: VirtualCondition = condition,
            queue: VirtualQueue = queue,
            got: list[object] = got,
        ) -> None:
            got.append(event.wait(100.0))
            with condition:
                got.append(condition.wait_for(lambda: "ready" in got, 100.0))
            got.extend(queue.get(timeout=100.0) for _ in range(3))

        def give(
            event: VirtualEvent = event,
            condition: VirtualCondition = condition,
            queue: VirtualQueue = queue,
            got: list[object] = got,
            scheduler: VirtualScheduler = scheduler,
        ) -> None:
            scheduler.sleep(1.0)
            event.set()
            scheduler.sleep(1.0)
            with condition:
                got.append("ready")
                condition.notify_all()
            for number in range(3):
                queue.put(number)

        finish(scheduler, started(scheduler, "process", take, give))
        assert got == [True, "ready", True, 0, 1, 2]
        assert scheduler.now == 2.0


def test_no_notification_is_lost_between_the_lock_and_the_wait() -> None:
    """Who gives up the lock of a condition waits at once, however often it has taken the lock; a change comes before or after."""
    for seed in range(100):
        scheduler = VirtualScheduler(seed)
        condition, ready = VirtualCondition(scheduler), list[str]()

        def take(condition: VirtualCondition = condition, ready: list[str] = ready) -> None:
            with condition, condition:
                while not ready:
                    condition.wait()

        def give(condition: VirtualCondition = condition, ready: list[str] = ready) -> None:
            with condition:
                ready.append("ready")
                condition.notify_all()

        finish(scheduler, started(scheduler, "process", take, give))


def test_a_killed_process_does_nothing_more() -> None:
    """No `finally` of it runs while anybody looks; what the system releases is released."""
    scheduler = VirtualScheduler(1)
    done: list[str] = []

    def work() -> None:
        try:
            scheduler.sleep(100.0)
            done.append("goes on")
        finally:
            done.append("finally")

    task = started(scheduler, "killed", work)
    task.held.append(lambda: done.append("released"))

    def kill() -> None:
        scheduler.sleep(1.0)
        scheduler.end(task, -9)
        scheduler.sleep(1000.0)

    finish(scheduler, started(scheduler, "killer", kill), until=2000.0)
    assert (task.alive, task.status) == (False, -9)
    assert done == ["released"]


def test_a_suspended_process_goes_on_when_it_is_continued() -> None:
    """What it waited for meanwhile is not lost."""
    scheduler = VirtualScheduler(1)
    queue, seen = VirtualQueue(scheduler), list[tuple[object, float]]()

    def take() -> None:
        seen.append((queue.get(timeout=1000.0), scheduler.now))

    task = started(scheduler, "suspended", take)

    def disturb() -> None:
        scheduler.sleep(1.0)
        scheduler.stop(task)
        queue.put("item")
        scheduler.sleep(9.0)
        assert seen == []
        scheduler.go_on(task)

    finish(scheduler, started(scheduler, "other", disturb), task)
    assert scheduler.errors == []
    assert seen == [("item", 10.0)]


def test_who_waits_for_ever_is_stuck() -> None:
    """Which is said at once."""
    scheduler = VirtualScheduler(1)
    task = started(scheduler, "process", VirtualEvent(scheduler).wait)
    with pytest.raises(Stuck, match="without a limit"):
        finish(scheduler, task)
    scheduler.take_down()


def test_who_takes_too_long_is_stuck() -> None:
    """At the end of the virtual time that there is."""
    scheduler = VirtualScheduler(1)
    task = started(scheduler, "process", lambda: scheduler.sleep(50.0))
    with pytest.raises(Stuck, match="10 virtual seconds"):
        finish(scheduler, task, until=10.0)
    scheduler.take_down()


def test_who_has_taken_too_long_may_be_given_more_time() -> None:
    """It still goes on when what it waits for has come."""
    scheduler = VirtualScheduler(1)
    task = started(scheduler, "a", lambda: scheduler.sleep(20.0))
    with pytest.raises(Stuck, match="10 virtual seconds"):
        finish(scheduler, task, until=10.0)
    finish(scheduler, task, until=30.0)


def test_an_exception_ends_its_thread_only() -> None:
    """It is told."""
    scheduler = VirtualScheduler(1)
    done: list[str] = []

    def fail() -> None:
        raise ValueError("of a test")

    def work() -> None:
        scheduler.sleep(1.0)
        done.append("work")

    finish(scheduler, started(scheduler, "process", fail, work))
    assert done == ["work"]
    assert [(thread, str(error)) for thread, error in scheduler.errors] == [("process: fail", "of a test")]


def test_something_happens_after_so_many_events() -> None:
    """Between the turns of threads."""
    scheduler = VirtualScheduler(1)
    at: list[int] = []
    scheduler.after(5, lambda: at.append(scheduler.events))

    def work() -> None:
        for number in range(10):
            scheduler.note("step", number)
            scheduler.sleep(0.1)

    finish(scheduler, started(scheduler, "process", work))
    assert at == [5]


@pytest.mark.parametrize("seed", SEEDS)
def test_an_error_is_raised_in_a_thread_that_waits(seed: int) -> None:
    """At once, and only once: what it waited for then reaches others."""
    scheduler = VirtualScheduler(seed)
    queue, caught = VirtualQueue(scheduler), list[float]()

    def waits() -> None:
        try:
            queue.get()
        except KeyboardInterrupt:
            caught.append(scheduler.now)
        scheduler.sleep(1.0)
        caught.append(scheduler.now)

    task = started(scheduler, "program", waits)
    scheduler.at(5.0, lambda: scheduler.raise_in(task.threads[0], KeyboardInterrupt()))
    scheduler.at(5.5, lambda: queue.put("late"))
    finish(scheduler, task)
    assert caught == [5.0, 6.0]
    assert queue.get_nowait() == "late"


def test_an_error_that_comes_between_waits_is_raised_at_the_next() -> None:
    """As a signal is that comes while a program calculates."""
    scheduler = VirtualScheduler(1)
    caught: list[str] = []

    def calculates() -> None:
        scheduler.raise_in(task.threads[0], KeyboardInterrupt())
        caught.append("goes on")
        try:
            scheduler.sleep(1.0)
        except KeyboardInterrupt:
            caught.append("raised")

    task = started(scheduler, "program", calculates)
    finish(scheduler, task)
    assert caught == ["goes on", "raised"]


def test_a_process_that_hangs_has_other_threads() -> None:
    """Only its first one does not go on, until it hangs no more."""
    scheduler = VirtualScheduler(1)
    done: dict[str, float] = {}

    def first() -> None:
        scheduler.sleep(1.0)
        done["first"] = scheduler.now

    def second() -> None:
        scheduler.sleep(1.0)
        done["second"] = scheduler.now

    task = started(scheduler, "program", first, second)
    scheduler.hang(task.threads[0], 5.0)
    finish(scheduler, task)
    assert done == {"first": 6.0, "second": 1.0}  # it hung before it began to sleep


def test_the_end_of_a_pipe_comes_when_all_who_write_have_closed_it() -> None:
    """A process that inherits it keeps it open."""
    scheduler = VirtualScheduler(1)
    pipe = Pipe(scheduler)
    end = pipe.end()
    inherited = end.again()
    read: list[bytes] = []

    def reads() -> None:
        while data := pipe.read(10):
            read.append(data)

    def writes() -> None:
        with end:
            end.write(b"a")
        end.close()
        scheduler.sleep(1.0)
        inherited.write(b"b")
        inherited.close()

    finish(scheduler, started(scheduler, "programs", reads, writes))
    assert b"".join(read) == b"ab"


def test_a_full_pipe_is_waited_for_as_long_as_its_writer_says() -> None:
    """And says how much it took."""
    scheduler = VirtualScheduler(1)
    taken: list[int] = []

    def writes() -> None:
        taken.append(Pipe(scheduler).write(bytes(100_000), 3.0))

    finish(scheduler, started(scheduler, "program", writes))
    assert taken == [1 << 16]
    assert scheduler.now == 3.0


def test_a_wait_for_less_than_the_clock_can_measure_ends() -> None:
    """0.1 s after 5 s are 5.1 s, which is 4e-16 s less than 0.1 s later: less than the next number after 5.1."""
    scheduler = VirtualScheduler(1)
    ended: list[float] = []

    def waits() -> None:
        scheduler.sleep(5.0)
        began, place = scheduler.now, deque[Waiter]()
        for _ in range(100):
            left = 0.1 - (scheduler.now - began)
            if left <= 0.0:
                ended.append(scheduler.now)
                return
            scheduler.wait(place, left)

    finish(scheduler, started(scheduler, "program", waits))
    assert ended == [pytest.approx(5.1)]


class _OpenFile:
    """A file that knows its world, as those of a simulated disk do."""

    closed = False

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self.scheduler = scheduler

    def write(self, data: bytes) -> int:
        return len(data)

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


def taken_down() -> weakref.ref[VirtualScheduler]:
    """A world in which a thread that was killed has not closed its writer."""
    scheduler = VirtualScheduler(1)
    task = scheduler.process("killed")

    def write() -> None:
        writer = pa.PythonFile(_OpenFile(scheduler), mode="w")
        task.held.append(writer.flush)
        scheduler.wait(deque(), None)

    scheduler.thread("writes", write, task).start()
    scheduler.run(1.0, lambda: bool(task.held))
    scheduler.take_down()
    return weakref.ref(scheduler)


def test_a_world_that_is_taken_down_is_freed() -> None:
    """Arrow keeps the file of a writer, and Python does not see that."""
    world = taken_down()
    gc.collect()
    gc.collect()
    assert world() is None
