"""How the programs of simulated sessions get what arrives: by channels, or by functions that are called.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Protocol, Self, final

import zenoh

from evedrop.virtual.scheduler import Waiter
from evedrop.virtual.zenoh.transport import AnySession

_CALLBACK_ROOM = 256
"""How many items wait for a function that a thread calls with them; then who has another one waits."""


@final
@dataclass(frozen=True)
class FifoChannel:
    """A handler that keeps up to `capacity` messages; then the session's receiving thread waits."""

    capacity: int


@final
@dataclass(frozen=True)
class RingChannel:
    """A handler that keeps the last `capacity` messages, and forgets the oldest ones; nobody waits. With its end all are gone."""

    capacity: int


@final
class Callback:
    """A handler that calls a function with each item, and another one when no more will come."""

    def __init__(
        self, callback: Callable[[Any], object], drop: Callable[[], object] | None = None, *, indirect: bool = True
    ) -> None:
        """indirect: whether a thread of its own calls them, rather than that which has the item."""
        self.indirect, self._callback, self._drop = indirect, callback, drop

    def __call__(self, item: Any) -> None:
        """Take an item."""
        self._callback(item)

    def end(self) -> None:
        """No more will come."""
        if self._drop is not None:
            self._drop()


class VirtualDeclaration:
    """What a session has declared; as a context manager, it is undeclared at the end."""

    def undeclare(self) -> None:
        """End it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undeclare()


class Taker(Protocol):
    """What takes the items of a handler."""

    def put(self, item: Any) -> None:
        """Take an item, unless it has ended."""

    def end(self) -> None:
        """No more will come."""


@final
class Channel:
    """Keeps up to `capacity` items; a thread that has another one waits, or the oldest one is forgotten."""

    def __init__(self, session: AnySession, capacity: int, *, forgets: bool = False) -> None:
        self._scheduler, self._task, self._capacity = session.scheduler, session.task, capacity
        self._forgets = forgets
        self._kept: deque[Any] = deque()
        self._readers: deque[Waiter] = deque()
        self._full: deque[Waiter] = deque()
        self._over = False

    def put(self, item: Any) -> None:
        """Add an item, unless the channel has ended."""
        if self._forgets and len(self._kept) >= self._capacity:
            self._kept.popleft()
        can_wait = self._scheduler.current is not None  # the world itself, which ends a question in time, cannot
        while can_wait and len(self._kept) >= self._capacity and not self._over:
            self._scheduler.wait(self._full)
        if not self._over:
            self._kept.append(item)
            self._scheduler.wake(self._readers)

    def recv(self) -> Any:
        """Wait for the next item. Raises ZError once the channel has ended and all are read."""
        while (item := self.try_recv()) is None:
            self._scheduler.wait(self._readers)
        return item

    def try_recv(self) -> Any:
        """The next item, if there is one. Raises ZError once the channel has ended and all are read."""
        if self._kept:
            self._task.allocate()
            item = self._kept.popleft()
            self._scheduler.wake(self._full)
            return item
        if self._over:
            raise zenoh.ZError("the channel has ended")
        return None

    def end(self) -> None:
        """Nothing comes any more."""
        self._over = True
        if self._forgets:
            self._kept.clear()
        self._scheduler.wake(self._readers)
        self._scheduler.wake(self._full)


@final
class DirectCalls:
    """Calls the functions of a handler on the thread that has an item."""

    def __init__(self, session: AnySession, handler: Callback) -> None:
        self._session, self._handler = session, handler
        self._over = False

    def put(self, item: Any) -> None:
        """Hand over an item."""
        if not self._over:
            self._call(lambda: self._handler(item))

    def end(self) -> None:
        """Tell that there are no more."""
        if not self._over:
            self._over = True
            self._call(self._handler.end)

    def _call(self, function: Callable[[], object]) -> None:
        scheduler = self._session.scheduler
        if scheduler.current is None:  # the time for answers is over
            scheduler.thread("calls back", lambda: attempt(self._session, function), self._session.task).start()
        else:
            attempt(self._session, function)


def taker_of(session: AnySession, handler: FifoChannel | RingChannel | Callable[[Any], object]) -> Taker:
    """What takes the items of a handler; for a function, a thread of its own calls it for one item after the other."""
    if isinstance(handler, FifoChannel | RingChannel):
        return Channel(session, handler.capacity, forgets=isinstance(handler, RingChannel))
    function = handler if isinstance(handler, Callback) else Callback(handler)
    if not function.indirect:
        return DirectCalls(session, function)
    channel = Channel(session, _CALLBACK_ROOM)

    def call() -> None:
        for item in items_of(channel):
            attempt(session, partial(function, item))
            del item  # a question that nobody holds has all its answers
        attempt(session, function.end)

    session.scheduler.thread("calls back", call, session.task).start()
    return channel


def items_of(channel: Channel) -> Iterator[Any]:
    """The items of a channel, until it has ended."""
    with suppress(zenoh.ZError):
        while True:
            yield channel.recv()


def attempt(session: AnySession, function: Callable[[], object]) -> None:
    """Call a function of a program, unless that has ended; the real Zenoh only logs what it raises."""
    try:
        if session.task.alive:
            function()
    except Exception as error:
        session.scheduler.failed(f"{session.task.name}: a callback", error)
