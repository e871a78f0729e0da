"""Virtual time, and threads that take turns: a seed decides which goes on next, and everything that happens is an event.

A thread is a greenlet: it goes on until it waits for something of the world, or until the seed interrupts it where it touches
something that others share. While nobody can go on, time passes. A thread belongs to a process; a killed process's threads never
go on, so that nothing of theirs is flushed, released or removed, as after SIGKILL.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import hashlib
import heapq
import random
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from queue import Empty
from types import TracebackType
from typing import Any, TypeVar, final

from greenlet import getcurrent, greenlet

from evedrop.virtual import notes

T = TypeVar("T")
_INTERRUPTED = 0.1
"""The fraction of the places where a thread touches something shared at which another one goes on first."""
_TICK = 1e-9
"""The shortest time limit, in seconds, as with real clocks: time must pass while a thread waits for what is due in less."""
_MOST_THROWS = 1000
"""How often a thread that is taken down may catch that."""
_UNENDING: list[Any] = []
"""The greenlets of those that did so each time: to delete them would let them go on."""


class Ended(BaseException):
    """The process of this thread has ended by its own act, or is gone; only the scheduler catches it."""


class Stuck(Exception):
    """The simulated time is over, or every thread waits for another one, without a limit."""


@dataclass(frozen=True)
class Occurrence:
    """Something that happened."""

    at: float
    """Virtual seconds."""
    process: str
    what: str
    words: tuple[object, ...]


@final
@dataclass(eq=False)
class VirtualTask:
    """A process: its threads, and whether they may go on."""

    name: str
    number: int
    """Its process id."""
    host: str = ""
    """The machine that it is on; empty for that of the launcher."""
    clock: float = 0.0
    """By how many seconds its machine's clock is fast."""
    alive: bool = True
    stopped: bool = False
    """Whether it is suspended, as by SIGSTOP."""
    since: float = 0.0
    """When it was suspended."""
    status: int | None = None
    threads: list[VirtualThread] = field(default_factory=list)
    held: list[Callable[[], object]] = field(default_factory=list)
    """What its end releases, whatever ended it: connections, pipes."""
    files: list[Callable[[], object]] = field(default_factory=list)
    """What closes the real files and folders that it has open: its end, or that of the world."""
    waiting: list[Waiter] = field(default_factory=list)
    """Threads that may go on once it is continued."""
    on_failure: Callable[[BaseException], object] | None = None
    """Called with an error that ends a thread; None: it is told, and the other threads go on."""
    lacks_memory: bool = False
    """Whether its next large allocation fails."""

    def close_files(self) -> None:
        """Close what it has open."""
        for close in reversed(self.files):
            close()
        self.files.clear()

    def allocate(self) -> None:
        """It asks for more memory than a little. Raises MemoryError once, if it lacks memory."""
        if self.lacks_memory:
            self.lacks_memory = False
            raise MemoryError


@final
class Waiter:
    """A thread that waits, until it is woken up by what it waits for or by time: by whichever is first."""

    __slots__ = ("gone", "thread", "value")

    def __init__(self, thread: VirtualThread) -> None:
        self.thread, self.gone, self.value = thread, False, False


@final
class VirtualThread:
    """A thread of a simulated process."""

    def __init__(
        self,
        scheduler: VirtualScheduler,
        task: VirtualTask,
        name: str,
        work: Callable[[], object],
        admit: Callable[[], object] = lambda: None,
    ) -> None:
        """admit: called before it is started; raises an error if it cannot be."""
        self.name, self.task, self._scheduler, self._work, self._admit = name, task, scheduler, work, admit
        self.ident: int | None = None
        self.over = False
        self.waiter: Waiter | None = None
        """As which it waits, or has waited last."""
        self.raises: BaseException | None = None
        """What it raises when it goes on."""
        self.hangs = False
        """Whether it does not go on, although its process does."""
        self.held_up: list[Waiter] = []
        """It itself, if it was to go on meanwhile."""
        self._joining: deque[Waiter] = deque()
        self.greenlet: Any = None

    def start(self) -> None:
        """Start it. Raises RuntimeError if the machine lacks threads."""
        self._admit()
        self.ident = self._scheduler.number()
        self.task.threads.append(self)
        self.greenlet = greenlet(self._run, parent=self._scheduler.hub)
        self.greenlet.evedrop_thread = self
        self._scheduler.make_ready(self)
        self._scheduler.interruptible()

    def _run(self, *_: object) -> None:
        with suppress(Ended):
            self._work_or_fail()
        self.over = True
        if self.task.alive:
            self._scheduler.wake(self._joining)

    def _work_or_fail(self) -> None:
        try:
            self._work()
        except (Ended, SystemExit):
            pass
        except BaseException as error:
            if self.task.on_failure is None:
                self._scheduler.failed(f"{self.task.name}: {self.name}", error)
            else:
                self.task.on_failure(error)

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended."""
        if self.ident is not None and not self.over:
            self._scheduler.wait(self._joining, timeout)

    def is_alive(self) -> bool:
        """Whether it runs."""
        return self.ident is not None and not self.over


@final
class VirtualScheduler:
    """Lets threads go on in an order that a seed decides."""

    def __init__(self, seed: int, keep: bool = False) -> None:
        """keep: whether to keep what happened, to be shown; its hash is made in any case."""
        self.seed = seed
        self.random = random.Random(seed)  # noqa: S311 - to be repeated, not to be secret
        self.now = 0.0
        self.hub = getcurrent()
        self.events = 0
        self.happened: list[Occurrence] = []
        self.errors: list[tuple[str, BaseException]] = []
        """Thread → the exception that ended it without being caught."""
        self._keep, self._hash = keep, hashlib.blake2b(digest_size=8)
        self._ready: list[VirtualThread | Waiter] = []
        self._timers: list[tuple[float, int, Waiter | Callable[[], object]]] = []
        self._number = 1000
        self.current: VirtualThread | None = None
        self.tasks: list[VirtualTask] = []
        self.check: Callable[[], object] = lambda: None
        """Called before each thread goes on; what it raises ends the world."""
        self.on_stop: Callable[[VirtualTask], object] = lambda _: None
        """What else happens when a process is suspended."""
        self.watchers: list[Callable[[str, str, tuple[object, ...]], object]] = []
        """Are called with each note: whose it is, its word, and the others."""
        self._plans: list[tuple[int, int, Callable[[], object]]] = []
        """After how many events something is to happen to the world."""

    def number(self) -> int:
        """A number that nothing else has."""
        self._number += 1
        return self._number

    @property
    def digest(self) -> str:
        """The hash of everything that happened so far."""
        return self._hash.hexdigest()

    def note(self, what: str, *words: object) -> None:
        """Something happens: it is counted, hashed, and kept to be shown."""
        self.events += 1
        name = self.current.task.name if self.current is not None else "world"
        self._hash.update(repr((round(self.now, 9), name, what, words)).encode())
        if self._keep:
            self.happened.append(Occurrence(self.now, name, what, words))
        for watch in self.watchers:
            watch(name, what, words)

    # Processes and threads

    def process(self, name: str, host: str | None = None) -> VirtualTask:
        """A new process without threads; host: its machine, by default that of the process that starts it."""
        if host is None:
            host = "" if self.current is None else self.current.task.host
        task = VirtualTask(name, self.number(), host)
        self.tasks.append(task)
        return task

    def thread(
        self,
        name: str,
        work: Callable[[], object],
        task: VirtualTask | None = None,
        admit: Callable[[], object] = lambda: None,
    ) -> VirtualThread:
        """A thread, not started yet, of this process or another; admit: as for `VirtualThread`."""
        if task is None:
            task = self._running.task
        return VirtualThread(self, task, name, work, admit)

    @property
    def _running(self) -> VirtualThread:
        if self.current is None:
            raise AssertionError("the world itself cannot wait")
        return self.current

    def end(self, task: VirtualTask, status: int) -> None:
        """End a process where it is: no thread of it goes on. If it is the current one, this never returns."""
        if not task.alive:
            return
        self.note(notes.ENDS, task.name, status)
        task.alive, task.status, task.stopped = False, status, False
        for release in reversed(task.held):
            release()
        task.held.clear()
        task.close_files()
        if self.current is not None and self.current.task is task:
            self.hub.switch()
            raise Ended  # when everything is taken down

    def stop(self, task: VirtualTask) -> None:
        """Suspend a process."""
        if task.alive and not task.stopped:
            self.note(notes.SUSPENDED, task.name)
            task.stopped, task.since = True, self.now
            self.on_stop(task)
            if self.current is not None and self.current.task is task:
                self.make_ready(self.current)
                self.hub.switch()

    def go_on(self, task: VirtualTask) -> None:
        """Continue a suspended process."""
        if task.alive and task.stopped:
            self.note(notes.GOES_ON, task.name)
            task.stopped = False
            self._ready += task.waiting
            task.waiting = []

    def hang(self, thread: VirtualThread, seconds: float | None) -> None:
        """Let a thread not go on for some time, or for good, while the others of its process do."""
        thread.hangs = True
        self.after_seconds(seconds, partial(self._end_hang, thread))

    def _end_hang(self, thread: VirtualThread) -> None:
        thread.hangs = False
        self._ready += thread.held_up
        thread.held_up = []

    def failed(self, thread: str, error: BaseException) -> None:
        """An exception that nobody caught has ended a thread."""
        self.errors.append((thread, error))

    # Waiting

    def make_ready(self, thread: VirtualThread | Waiter) -> None:
        """Let a thread go on."""
        self._ready.append(thread)

    def interruptible(self) -> None:
        """A place where another thread may go on first."""
        current = self.current
        if current is not None and current.task.alive and self.random.random() < _INTERRUPTED:
            self._ready.append(current)
            self._switch(current)

    def _switch(self, current: VirtualThread) -> None:
        self.hub.switch()
        if not current.task.alive:
            raise Ended
        if current.raises is not None:
            error, current.raises = current.raises, None
            raise error

    def raise_in(self, thread: VirtualThread, error: BaseException) -> None:
        """Let a thread raise an error where it waits, or where it is interrupted or waits next."""
        thread.raises = error
        if thread.waiter is not None and not thread.waiter.gone:
            thread.waiter.gone = True
            self._ready.append(thread.waiter)

    def wait(self, place: deque[Waiter], timeout: float | None = None) -> bool:
        """Wait until woken up at this place, or for `timeout` seconds; returns whether it was woken up."""
        current = self._running
        waiter = current.waiter = Waiter(current)
        place.append(waiter)
        if timeout is not None:
            self.at(self.now + (max(timeout, _TICK) if timeout > 0.0 else 0.0), waiter)
        self._switch(current)
        return waiter.value

    def wait_for(self, ready: Callable[[], T], wait: Callable[[float | None], object], timeout: float | None) -> T:
        """Wait, as often as needed, until something is true, or for `timeout` seconds; returns it. wait: for some seconds."""
        deadline = self.later(timeout)
        while not (result := ready()) and (left := deadline - self.now) > 0.0:
            wait(None if timeout is None else left)
        return result

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        current = self._running
        current.waiter = Waiter(current)
        self.at(self.now + max(0.0, seconds), current.waiter)
        self._switch(current)

    def wake(self, place: deque[Waiter], most: int | None = None) -> int:
        """Wake up the threads that wait at a place, the first `most` of them; returns how many."""
        woken = 0
        while place and (most is None or woken < most):
            waiter = place.popleft()
            if not waiter.gone and waiter.thread.task.alive:
                waiter.gone = waiter.value = True
                self._ready.append(waiter)
                woken += 1
        return woken

    def at(self, moment: float, what: Waiter | Callable[[], object]) -> None:
        """At this moment, let a thread go on, or something happen to the world."""
        heapq.heappush(self._timers, (moment, self.number(), what))

    def later(self, seconds: float | None) -> float:
        """The moment in some seconds; None: never."""
        return float("inf") if seconds is None else self.now + seconds

    def after_seconds(self, seconds: float | None, act: Callable[[], object]) -> None:
        """In some seconds, do something to the world; None: never."""
        if seconds is not None:
            self.at(self.now + seconds, act)

    def after(self, events: int, act: Callable[[], object]) -> None:
        """Once this many events have happened, do something to the world, between the turns of threads."""
        heapq.heappush(self._plans, (events, self.number(), act))

    def after_some(
        self, count: int, counts: Callable[[str, tuple[object, ...]], bool], act: Callable[[], object]
    ) -> None:
        """Once so many notes that count have been made, do something to the world; counts: whether one does, by its words."""
        left = count

        def watch(_: str, what: str, words: tuple[object, ...]) -> None:
            nonlocal left
            if left and counts(what, words):
                left -= 1
                if not left:
                    self.after(self.events, act)

        self.watchers.append(watch)

    def run(self, until: float, done: Callable[[], bool]) -> None:
        """Let everything happen until `done`. Raises Stuck if that is not before this moment, or cannot be any more."""
        while not done():
            self.check()
            while self._plans and self.events >= self._plans[0][0]:
                heapq.heappop(self._plans)[2]()
            if self._ready:
                ready = self._ready
                index = self.random.randrange(len(ready))
                ready[index], ready[-1] = ready[-1], ready[index]
                self._go_on(ready.pop())
            elif self._timers:
                moment, number, what = heapq.heappop(self._timers)
                if isinstance(what, Waiter) and what.gone:
                    continue
                if moment > until:
                    heapq.heappush(self._timers, (moment, number, what))
                    raise Stuck(f"not done after {until:.0f} virtual seconds")
                if isinstance(what, Waiter):
                    what.gone = True
                self.now = max(self.now, moment)
                if isinstance(what, Waiter):
                    self._go_on(what)
                else:
                    what()
            else:
                raise Stuck("everybody waits for another, without a limit")

    def _go_on(self, next_one: VirtualThread | Waiter) -> None:
        thread = next_one.thread if isinstance(next_one, Waiter) else next_one
        task = thread.task
        if not task.alive or thread.over:
            return
        if task.stopped or thread.hangs:
            waiter = next_one if isinstance(next_one, Waiter) else Waiter(thread)
            (task.waiting if task.stopped else thread.held_up).append(waiter)
            return
        self.current = thread
        thread.greenlet.switch()
        self.current = None

    def take_down(self) -> None:
        """Unwind what is left of all threads, once nobody looks at the world any more."""
        for task in self.tasks:
            task.alive = False
        for task in self.tasks:
            for thread in task.threads:
                for _ in range(_MOST_THROWS):
                    if not thread.greenlet:
                        break
                    self.current = thread
                    thread.greenlet.throw(Ended)
                else:
                    _UNENDING.append(thread.greenlet)
                thread.greenlet = None
        self.current = None
        # Arrow's writers refer to files without Python's knowledge: a world that can be reached from a file would never be freed.
        for task in self.tasks:
            task.threads.clear()
            task.held.clear()
            task.close_files()
            task.waiting.clear()
        self._ready.clear()
        self._timers.clear()


@final
class VirtualLock:
    """A lock; `again`: whether its holder can take it again."""

    def __init__(self, scheduler: VirtualScheduler, again: bool = False) -> None:
        self._scheduler, self._again = scheduler, again
        self._holder: VirtualThread | None = None
        self._depth = 0
        self.waiting: deque[Waiter] = deque()

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Take it."""
        scheduler = self._scheduler
        me = scheduler.current
        if me is None:  # the world itself, between the turns of threads
            return self._holder is None
        scheduler.interruptible()
        if self._holder is not None:
            seconds = 0.0 if not blocking else None if timeout < 0 else timeout
            if not scheduler.wait_for(self._is_free, partial(scheduler.wait, self.waiting), seconds):
                return False
        self._holder, self._depth = me, self._depth + 1
        return True

    def _is_free(self) -> bool:
        """Whether the current thread can take it."""
        return self._holder is None or (self._again and self.held_by_me())

    def release(self) -> None:
        """Give it back."""
        if self._holder is None:
            return
        if self._depth == 1:
            self.give_up()
            self._scheduler.interruptible()
        else:
            self._depth -= 1

    def give_up(self) -> None:
        """Give it back, however often it was taken; no other thread goes on before the current one waits."""
        self._holder, self._depth = None, 0
        self._scheduler.wake(self.waiting, 1)

    def held_by_me(self) -> bool:
        """Whether the current thread has it."""
        return self._holder is not None and self._holder is self._scheduler.current

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


@final
class VirtualCondition:
    """A condition with a lock."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler, self._lock = scheduler, VirtualLock(scheduler, again=True)
        self._waiting: deque[Waiter] = deque()
        self.acquire, self.release = self._lock.acquire, self._lock.release

    def __enter__(self) -> bool:
        return self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until notified."""
        self._lock.give_up()
        try:
            return self._scheduler.wait(self._waiting, timeout)
        finally:
            self._lock.acquire()

    def wait_for(self, predicate: Callable[[], T], timeout: float | None = None) -> T:
        """Wait until something is true."""
        return self._scheduler.wait_for(predicate, self.wait, timeout)

    def notify(self, n: int = 1) -> None:
        """Wake up threads that wait."""
        self._scheduler.wake(self._waiting, n)

    def notify_all(self) -> None:
        """Wake up all of them."""
        self._scheduler.wake(self._waiting)


@final
class VirtualEvent:
    """Something that happens once."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler, self._set = scheduler, False
        self._waiting: deque[Waiter] = deque()

    def is_set(self) -> bool:
        """Whether it has happened."""
        return self._set

    def set(self) -> None:
        """It happens."""
        self._set = True
        self._scheduler.wake(self._waiting)
        self._scheduler.interruptible()

    def clear(self) -> None:
        """It has not happened."""
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it happens."""
        if not self._set:
            self._scheduler.wait(self._waiting, timeout)
        return self._set


@final
class VirtualQueue:
    """Items in order."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler = scheduler
        self._items: deque[Any] = deque()
        self._waiting: deque[Waiter] = deque()

    def put(self, item: Any) -> None:
        """Add an item."""
        self._items.append(item)
        self._scheduler.wake(self._waiting, 1)
        self._scheduler.interruptible()

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """Take the next item."""
        if block and not self._items:
            scheduler = self._scheduler
            scheduler.wait_for(self.qsize, partial(scheduler.wait, self._waiting), timeout)
        if not self._items:
            raise Empty
        return self._items.popleft()

    def get_nowait(self) -> Any:
        """Take the next item."""
        return self.get(block=False)

    def empty(self) -> bool:
        """Whether there is none."""
        return not self._items

    def qsize(self) -> int:
        """How many there are."""
        return len(self._items)
