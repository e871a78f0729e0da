"""A process and its launcher: the events that it sends there, and whether the launcher is gone.

The events are that a router listens, and the recorder's, including its heartbeat. The launcher gives up on a recorder that is
silent for half a minute. So the heartbeat has its own thread: it continues while the recorder imports, computes or writes,
however long that takes on a busy machine.
"""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self, TextIO, cast, final

from evedrop.live.protocol.launcher_events import Alive
from evedrop.scenario.progress_events import ProgressEvent
from evedrop.system.output import Output

_BEAT_SECONDS = 1.0
_LINE = threading.Lock()  # one line at a time


_TO: list[TextIO] = []
"""The stream for a launched process's events; empty before `keep_events_apart`, and in a process that was started by hand."""


def keep_events_apart(launched: bool) -> None:
    """Redirect file descriptor 1 to standard error: Zenoh logs to it, and would mix its lines into the events.

    launched: whether a launcher reads the events, from the former standard output; `print` then writes to the log.
    """
    sys.stdout.flush()
    apart = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    if launched:
        _TO.append(apart)
    else:
        sys.stdout = cast(TextIO, Output(apart))


def emit(event: ProgressEvent) -> None:
    """Send an event to the launcher, or to standard output if there is none; harmless if nobody reads it."""
    left = memoryview(event.line)
    with _LINE, suppress(OSError, ValueError, AttributeError):  # the launcher is gone, or there is no standard output
        to = _TO[0] if _TO else sys.stdout
        while left:
            left = left[os.write(to.fileno(), left) :]


@final
class Heartbeat:
    """Sends the heartbeat to the launcher, every second while the block runs."""

    def __init__(self, seconds: float = _BEAT_SECONDS) -> None:
        self._seconds = seconds
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

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
        # Not sys.stdin: a thread that waits in its lock makes the interpreter abort at exit.
        rest = b""
        while read := os.read(0, 4096):
            *lines, rest = (rest + read).split(b"\n")
            for line in lines:
                hear(line)
        then()

    threading.Thread(target=wait, name="launcher-watchdog", daemon=True).start()


def launcher_is_gone() -> bool:
    """Whether the other end of standard input, a pipe, is closed; asks the system, so it does not depend on a thread."""
    poll = select.poll()
    poll.register(0, 0)
    return bool(poll.poll(0))
