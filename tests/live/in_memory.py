"""A session in memory: the test puts what a process receives, and reads what it sends."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, Self

from evedrop.live.network.process_session import ReplayBuffer
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.commands import Bounds, ControlCommand, StatusReporter, read_command
from evedrop.live.protocol.keys import RunKeys
from tests.conftest import LIMIT


@dataclass
class Stage:
    """What a peer's session would carry: the test fills the queues and reads what was put."""

    queues: dict[str, SimpleQueue[bytes]] = field(default_factory=dict)
    callbacks: dict[str, Callable[[bytes], None]] = field(default_factory=dict)
    put: SimpleQueue[tuple[str, bytes]] = field(default_factory=SimpleQueue)
    buffers: dict[str, ReplayBuffer] = field(default_factory=dict)
    commands: SimpleQueue[bytes] = field(default_factory=SimpleQueue)
    """The conductor's commands, as its classes pack them."""

    def session(self, brief: AnyBrief) -> Any:
        """In the place of a `Session`: what the work of a process uses of it."""
        return FakeSession(self, RunKeys(brief.run), brief)

    def fill(self, key: str, messages: list[bytes]) -> None:
        """Put messages into a subscription."""
        queue = self.queues.setdefault(key, SimpleQueue())
        for message in messages:
            queue.put(message)

    def all(self, key: str) -> list[bytes]:
        """All messages that were put on a key; the others are dropped."""
        payloads = []
        while not self.put.empty():
            where, payload = self.put.get()
            if where == key:
                payloads.append(payload)
        return payloads


class FakeSubscription:
    """The part of a subscription that peers use."""

    def __init__(self, queue: SimpleQueue[bytes]) -> None:
        self._queue = queue

    def recv(self) -> bytes:
        """The next message."""
        return self._queue.get(timeout=LIMIT)

    def take(self, most: int) -> list[bytes]:
        """The next message, and those after it."""
        payloads = [self.recv()]
        while len(payloads) < most and not self._queue.empty():
            payloads.append(self.recv())
        return payloads

    def __iter__(self) -> Iterator[bytes]:
        while not self._queue.empty():
            yield self.recv()


class FakeSession:
    """The part of `Session` that peers use."""

    def __init__(self, stage: Stage, keys: RunKeys, brief: AnyBrief) -> None:
        self._stage, self._process, self._slots = stage, brief.process, brief.slots
        self.keys = keys
        self.status = StatusReporter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stage.put.put(("closed", b""))

    def subscribe(self, key: str) -> FakeSubscription:
        """A subscription whose `recv` never waits for longer than a test may."""
        queue = self._stage.queues.setdefault(key, SimpleQueue())

        return FakeSubscription(queue)

    def subscribe_with(self, key: str, receive: Callable[[bytes], None]) -> None:
        """As the real one, called by the test."""
        self._stage.callbacks[key] = receive

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """Puts into the stage; what the process puts for itself comes back to it."""
        if key in self._stage.queues:
            return self._stage.queues[key].put
        return lambda payload: self._stage.put.put((key, payload))

    def replaying_publisher(self, key: str, *how: Any, **more: Any) -> ReplayBuffer:
        """The same, kept to be sent again."""
        self._stage.buffers[key] = buffer = ReplayBuffer(self.publisher(key), *how, **more)
        return buffer

    def ready(self) -> None:
        """Nobody to wait for."""

    appear = ready

    def wait_for(self, kind: type[ControlCommand]) -> None:
        """Until the test commands it."""
        while not isinstance(self.command(), kind):
            pass

    def command(self, receivers: Collection[str] | None = None) -> ControlCommand:
        """The next command, which the test gives."""
        message = Reader(self.keys.control(self._process), self._stage.commands.get(timeout=LIMIT))
        return read_command(message, Bounds(self._slots, receivers))

    def commanded(self, receivers: Collection[str] | None = None) -> ControlCommand | None:
        """The next command if the test has given one."""
        return None if self._stage.commands.empty() else self.command(receivers)
