"""The world in which a program runs: time, threads, locks and queues, this process, and Zenoh.

`world()` is the real one, unless a test has put the program into a simulated one (`evedrop.virtual`), where all programs of a run
live in one interpreter, time is virtual, and a seed decides which of them goes on next. A program does not know which it is.

So `threading`, `queue`, `time`, `signal` and the ends of processes are used here and in the other modules of this package only.
"""

from __future__ import annotations

import secrets
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Protocol, TypeVar, final

from evedrop.system.this_process import REAL_PROCESS, ThisProcess

T = TypeVar("T")


class Thread(Protocol):
    """A thread that has been made, and perhaps started."""

    @property
    def name(self) -> str:
        """What it does."""

    @property
    def ident(self) -> int | None:
        """Its number; None before its start."""

    def start(self) -> None:
        """Start it. Raises RuntimeError if the machine lacks threads."""

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended, or for `timeout` seconds."""

    def is_alive(self) -> bool:
        """Whether it runs."""


class Lock(Protocol):
    """A lock that one thread holds at a time."""

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Take it; returns whether this thread has it."""

    def release(self) -> None:
        """Give it back."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Condition(Lock, Protocol):
    """A lock whose holder can wait for another thread to change something."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until notified; returns whether that was before `timeout` seconds."""

    def wait_for(self, predicate: Callable[[], T], timeout: float | None = None) -> T:
        """Wait until something is true, or for `timeout` seconds; returns it."""

    def notify(self, n: int = 1) -> None:
        """Wake up threads that wait."""

    def notify_all(self) -> None:
        """Wake up all of them."""


class ThreadEvent(Protocol):
    """Something that happens once."""

    def is_set(self) -> bool:
        """Whether it has happened."""

    def set(self) -> None:
        """It happens."""

    def clear(self) -> None:
        """It has not happened."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it happens, or for `timeout` seconds; returns whether it has happened."""


class Queue(Protocol[T]):
    """Items in order, put and taken by any thread."""

    def put(self, item: T) -> None:
        """Add an item."""

    def get(self, block: bool = True, timeout: float | None = None) -> T:
        """Take the next item. Raises queue.Empty if there is none: at once if not `block`, otherwise after `timeout` seconds."""

    def get_nowait(self) -> T:
        """Take the next item. Raises queue.Empty if there is none."""

    def empty(self) -> bool:
        """Whether there is none."""

    def qsize(self) -> int:
        """How many there are."""


class World(ABC):
    """What a program needs of the machine that it runs on."""

    @abstractmethod
    def monotonic(self) -> float:
        """Seconds since some moment."""

    @abstractmethod
    def time(self) -> float:
        """Seconds since 1970, by the machine's clock."""

    @abstractmethod
    def sleep(self, seconds: float) -> None:
        """Let time pass."""

    @abstractmethod
    def thread(self, work: Callable[..., object], *arguments: object, name: str, daemon: bool = True) -> Thread:
        """A thread, not started yet."""

    @abstractmethod
    def lock(self) -> Lock:
        """A lock."""

    @abstractmethod
    def rlock(self) -> Lock:
        """A lock that the thread that holds it can take again."""

    @abstractmethod
    def condition(self) -> Condition:
        """A condition with a lock of its own."""

    @abstractmethod
    def event(self) -> ThreadEvent:
        """An event."""

    @abstractmethod
    def queue(self) -> Queue[Any]:
        """A queue without a limit."""

    @abstractmethod
    def token(self, size: int) -> bytes:
        """Bytes that nobody can guess."""

    @property
    @abstractmethod
    def process(self) -> ThisProcess:
        """The process that asks."""

    @property
    @abstractmethod
    def zenoh(self) -> Any:
        """The module `zenoh`, or what stands for it."""


@final
class RealWorld(World):
    """The machine."""

    def monotonic(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def time(self) -> float:
        """Seconds since 1970."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def thread(self, work: Callable[..., object], *arguments: object, name: str, daemon: bool = True) -> Thread:
        """A thread of the system."""
        return threading.Thread(target=work, args=arguments, name=name, daemon=daemon)

    def lock(self) -> Lock:
        """A lock."""
        return threading.Lock()

    def rlock(self) -> Lock:
        """A lock that its holder can take again."""
        return threading.RLock()

    def condition(self) -> Condition:
        """A condition."""
        return threading.Condition()

    def event(self) -> ThreadEvent:
        """An event."""
        return threading.Event()

    def queue(self) -> Queue[Any]:
        """A queue."""
        return SimpleQueue()

    def token(self, size: int) -> bytes:
        """Bytes that nobody can guess."""
        return secrets.token_bytes(size)

    @property
    def process(self) -> ThisProcess:
        """The process of this interpreter."""
        return REAL_PROCESS

    @property
    def zenoh(self) -> Any:
        """Zenoh itself, which the launcher does not import."""
        import zenoh  # noqa: PLC0415

        return zenoh


_world: World = RealWorld()


def world() -> World:
    """The world that this program is in."""
    return _world


@contextmanager
def inside(other: World) -> Iterator[None]:
    """Let all programs of this interpreter be in another world while the block runs."""
    global _world  # noqa: PLW0603 - this is its purpose
    before, _world = _world, other
    try:
        yield
    finally:
        _world = before
