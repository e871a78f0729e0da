"""A process and its launcher: the events that it sends there, and whether the launcher is gone.

The events are that a router listens, and the recorder's, including its heartbeat. The launcher gives up on a recorder that is
silent for half a minute. So the heartbeat has its own thread: it continues while the recorder imports, computes or writes,
however long that takes on a busy machine.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self, final

from evedrop.live.protocol.launcher_events import Alive
from evedrop.scenario.progress_events import ProgressEvent
from evedrop.system.world import world

_BEAT_SECONDS = 1.0


def emit(event: ProgressEvent) -> None:
    """Send an event to the launcher, or to standard output if there is none; harmless if nobody reads it."""
    with suppress(OSError, ValueError):
        world().process.send_event(event.line)


@final
class Heartbeat:
    """Sends the heartbeat to the launcher, every second while the block runs."""

    def __init__(self, seconds: float = _BEAT_SECONDS) -> None:
        self._seconds = seconds
        self._over = world().event()
        self._thread = world().thread(self._beat, name="heartbeat")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join(_BEAT_SECONDS)  # it waits if the launcher does not read

    def _beat(self) -> None:
        while not self._over.wait(self._seconds):
            emit(Alive())


def when_launcher_is_gone(then: Callable[[], None], hear: Callable[[bytes], None] = lambda _: None) -> None:
    """Call `then`, on a thread of its own, when standard input closes: the launcher holds its other end.

    hear: gets every line that the launcher writes.
    """

    def wait() -> None:
        rest = b""
        while read := world().process.read_input(4096):
            *lines, rest = (rest + read).split(b"\n")
            for line in lines:
                hear(line)
        then()

    world().thread(wait, name="launcher-watchdog").start()


def launcher_is_gone() -> bool:
    """Whether the other end of standard input, a pipe, is closed; asks the system, so it does not depend on a thread."""
    return world().process.input_closed()
