"""A process and its launcher: the events that it sends there, and whether the launcher is gone.

The events are that a router listens, and the recorder's, including its heartbeat. The launcher gives up on a recorder that is
silent for half a minute. So the heartbeat has its own thread: it continues while the recorder imports, computes or writes,
however long that takes on a busy machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from evedrop.live.protocol.launcher_events import Alive
from evedrop.scenario.progress_events import ProgressEvent
from evedrop.system.world import world

_BEAT_SECONDS = 1.0
_MOST_BYTES = 2**16


def emit(event: ProgressEvent) -> None:
    """Send an event to the launcher, or to standard output if there is none; harmless if nobody reads it."""
    with suppress(OSError, ValueError):
        world().process.send_event(event.line)


@contextmanager
def heartbeat() -> Iterator[None]:
    """Send the heartbeat to the launcher, every second while the block runs."""
    over = world().event()

    def beat() -> None:
        while not over.wait(_BEAT_SECONDS):
            emit(Alive())

    thread = world().thread(beat, name="heartbeat")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(_BEAT_SECONDS)  # it waits if the launcher does not read


def input_lines() -> Iterator[bytes]:
    """The lines that come on standard input until it closes; one that the end cuts off is no line."""
    begun: list[bytes] = []
    while read := world().process.read_input(_MOST_BYTES):
        end, *begins = read.split(b"\n")
        begun.append(end)
        for begin in begins:
            yield b"".join(begun)
            begun = [begin]


def when_launcher_is_gone(then: Callable[[], None], hear: Callable[[bytes], None] = lambda _: None) -> None:
    """Call `then`, on a thread of its own, when standard input closes: the launcher holds its other end.

    hear: gets every line that the launcher writes.
    """

    def wait() -> None:
        for line in input_lines():
            hear(line)
        then()

    world().thread(wait, name="launcher-watchdog").start()


def launcher_is_gone() -> bool:
    """Whether the other end of standard input, a pipe, is closed; asks the system, so it does not depend on a thread."""
    return world().process.input_closed()
