"""Pipes between simulated processes, and between a process and its launcher.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from types import TracebackType
from typing import final

from evedrop.virtual.scheduler import VirtualScheduler, Waiter

_ROOM = 1 << 16
"""How many bytes wait in a pipe before its writer has to."""


@final
class Pipe:
    """Bytes from one process to another."""

    def __init__(self, scheduler: VirtualScheduler) -> None:
        self._scheduler = scheduler
        self._held = bytearray()
        self._readers: deque[Waiter] = deque()
        self._writers: deque[Waiter] = deque()
        self._written, self._read = True, True
        self._open_ends = 0

    def write(self, data: bytes, seconds: float | None = None) -> int:
        """Write bytes, and wait while the pipe is full. Raises BrokenPipeError if nobody reads them.

        seconds: for how long to wait for room; None: as long as it takes. Returns how many bytes were written.
        """
        left = memoryview(data)
        while left:
            if not self._read:
                raise BrokenPipeError(32, "Broken pipe")
            room = _ROOM - len(self._held)
            if room == 0:
                if not self._scheduler.wait(self._writers, seconds):
                    return len(data) - len(left)
                continue
            self._held += left[:room]
            left = left[room:]
            self._scheduler.wake(self._readers)
        self._scheduler.interruptible()
        return len(data)

    def read(self, most: int) -> bytes:
        """Wait for bytes; none at the end."""
        while not self._held and self._written:
            self._scheduler.wait(self._readers)
        data = bytes(self._held[:most])
        del self._held[:most]
        self._scheduler.wake(self._writers)
        return data

    @property
    def over(self) -> bool:
        """Whether there is nothing more to read."""
        return not self._written and not self._held

    def close_writing(self) -> None:
        """The writer's end is closed."""
        self._written = False
        self._scheduler.wake(self._readers)

    def close_reading(self) -> None:
        """The reader's end is closed."""
        self._read = False
        self._scheduler.wake(self._writers)

    def end(self) -> WritingEnd:
        """One more end to write to: the reader gets the end of the pipe once all of them are closed."""
        self._open_ends += 1
        return WritingEnd(self, self._close_end)

    def _close_end(self) -> None:
        self._open_ends -= 1
        if self._open_ends == 0:
            self.close_writing()


class _End(AbstractContextManager["_End"]):
    """An end of a pipe as a file object, which is closed at the end of a block."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe

    def write(self, data: bytes) -> int:
        """Write bytes."""
        return self._pipe.write(data)

    def flush(self) -> None:
        """Everything is written already."""

    @abstractmethod
    def close(self) -> None:
        """Close this end."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@final
class WritingEnd(_End):
    """An end of a pipe that other processes can inherit."""

    def __init__(self, pipe: Pipe, close: Callable[[], object]) -> None:
        super().__init__(pipe)
        self._close, self._open = close, True

    def again(self) -> WritingEnd:
        """The same end for a process that inherits it."""
        return self._pipe.end()

    def close(self) -> None:
        """Close it, once."""
        if self._open:
            self._open = False
            self._close()


@final
class PipeFile(_End):
    """Either end of a pipe, or both."""

    def read(self, most: int) -> bytes:
        """Wait for bytes; none at the end."""
        return self._pipe.read(most)

    def close(self) -> None:
        """Close this end."""
        self._pipe.close_writing()
        self._pipe.close_reading()

    def __iter__(self) -> Iterator[bytes]:
        """The lines that come."""
        rest = b""
        while read := self._pipe.read(4096):
            *lines, rest = (rest + read).split(b"\n")
            yield from (line + b"\n" for line in lines)
        if rest:
            yield rest
