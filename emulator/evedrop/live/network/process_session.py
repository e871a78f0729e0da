"""The part of a session that the work of a process uses; tests pass one in memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from types import TracebackType
from typing import Protocol, Self

from evedrop.live.network.resending import ReplayBuffer
from evedrop.live.protocol.commands import ControlCommand
from evedrop.live.protocol.keys import RunKeys
from evedrop.live.protocol.process_status import StatusReporter


class Received(Protocol):
    """The messages of one key, in order."""

    def recv(self) -> bytes:
        """Wait for the next message."""

    def take(self, most: int) -> list[bytes]:
        """Wait for the next message; then it, and those that have arrived after it, up to `most` in all."""

    def __iter__(self) -> Iterator[bytes]: ...


class ProcessSession(Protocol):
    """A process's session; `Session` says what each method does."""

    keys: RunKeys
    status: StatusReporter

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def subscribe(self, key: str) -> Received:
        """Subscribe to a key."""

    def subscribe_with(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Subscribe to a key, with a function that takes its messages."""

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """A publisher for a key."""

    def replaying_publisher(
        self,
        key: str,
        span: int | None = None,
        head: Callable[[int, int, int], bytes] | None = None,
        back: int = 0,
    ) -> ReplayBuffer:
        """A publisher whose messages can be sent again."""

    def ready(self) -> None:
        """Wait for the readers, then appear."""

    def appear(self) -> None:
        """Show that this process is present."""

    def wait_for(self, kind: type[ControlCommand]) -> None:
        """Wait for a command."""

    def command(self, receivers: Collection[str] | None = None) -> ControlCommand:
        """Wait for the next command."""

    def commanded(self, receivers: Collection[str] | None = None) -> ControlCommand | None:
        """The next command, or None."""
