"""Threads, and what they share, as programs use them; `world()` makes them."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Protocol, TypeVar

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
