"""Ctrl-C, SIGTERM and SIGHUP of a command that has begun something: as an event, as an exception, or in any thread."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from evedrop.interrupts import INTERRUPTED, SIGNALS, heeded, leave

_Handler = Callable[[int, FrameType | None], object]


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM and SIGHUP set, while the block runs; outside the main thread signals stay as they are."""
    stop = threading.Event()
    with _handled(lambda *_: stop.set()):
        yield stop


@contextmanager
def raise_on_signals() -> Iterator[None]:
    """Have Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt while the block runs, so that what it made is removed."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handled(interrupt):
        yield


@contextmanager
def held_back() -> Iterator[None]:
    """Have processes that are started while the block runs get signals when they have handlers, and not before.

    An interpreter that is still starting would end with a traceback; `evedrop.interrupts` lets through what has come meanwhile.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _handled(handler: _Handler) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # What is ignored from birth stays so: nohup, and the interrupts of a job in the background.
    before = {number: signal.signal(number, handler) for number in heeded()}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def leave_on_signals() -> None:
    """From now on have Ctrl-C, SIGTERM and SIGHUP end this process at once, also while its main thread waits outside Python."""
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    for number in heeded():
        signal.signal(number, leave)

    def wait() -> None:
        os.read(ours, 1)
        os._exit(INTERRUPTED)

    threading.Thread(target=wait, name="signals", daemon=True).start()
