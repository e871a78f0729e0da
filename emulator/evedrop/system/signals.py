"""Handles Ctrl-C, SIGTERM and SIGHUP in a command: at its start it exits at once, later an event or an exception ends its work.

They end a command with status 130 at any moment: `heed_signals` comes before any slow import. The first signal counts: while the
block that it ends is left in order, further ones are ignored, unless it says otherwise.
"""

from __future__ import annotations

# The C module under `signal`: `signal` imports enum and more, which takes about as long as the interpreter needs to start.
import _signal as signal  # type: ignore[import-not-found]
import _thread
import os
import time
from contextlib import contextmanager

# Not from typing, whose import would take longer than everything before it; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager
    from types import FrameType
    from typing import NoReturn

INTERRUPTED = 130
"""The exit status of an interrupted command."""
SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The signals that interrupt a command."""
SHOW_STACKS: int = signal.SIGUSR1
"""The signal upon which a process of a run writes the stack of every thread to its log."""
AFTERTHOUGHT_SECONDS = 0.5
"""A signal that ended another process of a run may reach this one as well, within this time: then the run did not fail.

A closing terminal hangs up on all processes; a user may end them one by one.
"""
AGAIN_SECONDS = 1.0
"""A signal that comes within this time of another is not a second one: some programs, and terminals, send several."""


def heeded() -> list[int]:
    """The signals that are not ignored: nohup ignores SIGHUP, and a shell ignores SIGINT for background jobs."""
    return [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]


def leave(_number: int, _frame: FrameType | None) -> NoReturn:
    """Exit at once: there is nothing to end in order."""
    os._exit(INTERRUPTED)


def heed_signals() -> None:
    """Install `leave` as the handler; also handles signals that arrived while the interpreter started."""
    for number in heeded():
        signal.signal(number, leave)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)  # the starting process may have blocked them


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM and SIGHUP set while the block runs; has no effect outside the main thread.

    They set that of such a block around it, too: the inner one may be about to end by itself. A block that begins inside such a
    block after the signal has its event set.
    """
    import threading  # noqa: PLC0415 - the handlers come first

    stop = threading.Event()
    handlers = map(signal.getsignal, heeded())
    around = [handler for handler in handlers if isinstance(handler, _Handler) and handler.stops]
    if any(handler.called for handler in around):
        stop.set()

    def interrupt() -> None:
        # By a thread: the main thread may hold the lock of the event right now, and would wait for itself.
        _thread.start_new_thread(stop.set, ())
        for handler in around:
            handler.call()

    with _handled(interrupt, stops=True):
        yield stop


@contextmanager
def stop_or_leave_on_signals(leave: Callable[[], object]) -> Iterator[threading.Event]:
    """An event that the first signal sets while the block runs; a second one calls `leave`, which exits, whatever hangs.

    Both happen on a thread of its own, even while the main thread waits outside Python. Signals within `AGAIN_SECONDS` of the
    first count as one. Has no effect outside the main thread.
    """
    import threading  # noqa: PLC0415 - the handlers come first

    stop = threading.Event()
    if not _in_main_thread():
        yield stop
        return
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)

    def listen() -> None:
        first = 0.0
        while number := os.read(ours, 1):
            if number[0] not in SIGNALS:
                continue
            if not stop.is_set():
                first = time.monotonic()
                stop.set()
            elif time.monotonic() - first > AGAIN_SECONDS:
                leave()
        os.close(ours)

    threading.Thread(target=listen, name="signals", daemon=True).start()
    woken = signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    try:
        with _handled_by(_ignore):
            yield stop
    finally:
        signal.set_wakeup_fd(woken)
        os.close(theirs)


def raise_on_signals() -> AbstractContextManager[None]:
    """Make Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt while the block runs, so that its files are removed."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    return _handled(interrupt)


def leave_after(act: Callable[[], object], status: int = INTERRUPTED) -> AbstractContextManager[None]:
    """Make Ctrl-C, SIGTERM and SIGHUP call `act` and exit at once while the block runs."""

    def interrupt() -> None:
        act()
        os._exit(status)

    return _handled(interrupt)


@contextmanager
def told_when_suspended(tell: Callable[[], object]) -> Iterator[None]:
    """Call `tell` before Ctrl-Z suspends this process while the block runs; has no effect outside the main thread."""
    if not _in_main_thread() or signal.getsignal(signal.SIGTSTP) != signal.SIG_DFL:
        yield
        return

    def handler(_number: int, _frame: FrameType | None) -> None:
        tell()
        os.kill(os.getpid(), signal.SIGSTOP)

    signal.signal(signal.SIGTSTP, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)


@contextmanager
def held_back() -> Iterator[None]:
    """Delay signals to processes that are started in the block until they have handlers.

    An interpreter that is still starting would end with a traceback; `heed_signals` then unblocks pending signals.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _in_main_thread() -> bool:
    import threading  # noqa: PLC0415 - the handlers come first

    return threading.current_thread() is threading.main_thread()


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """The handler where signals have woken a thread already."""


class _Handler:
    """Calls a function upon the first signal, and ignores further ones; stops: whether it sets an event."""

    def __init__(self, interrupt: Callable[[], object], stops: bool) -> None:
        self._interrupt, self.stops = interrupt, stops
        self.called = False

    def call(self) -> None:
        """Call the function, unless it has been called."""
        if not self.called:
            self.called = True
            self._interrupt()

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.call()


@contextmanager
def _handled(interrupt: Callable[[], object], stops: bool = False) -> Iterator[None]:
    if not _in_main_thread():
        yield
        return
    with _handled_by(_Handler(interrupt, stops)):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    # Signals ignored from the start stay ignored: by nohup, and the interrupts of a background job.
    before = {number: signal.getsignal(number) for number in heeded()}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def leave_on_signals() -> None:
    """Make Ctrl-C, SIGTERM and SIGHUP end this process at once, even while its main thread waits outside Python."""
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    for number in heeded():
        signal.signal(number, leave)

    def wait() -> None:
        while os.read(ours, 1)[0] not in SIGNALS:  # another signal for which a library or a user's class has a handler
            pass
        os._exit(INTERRUPTED)

    import threading  # noqa: PLC0415 - the handlers come first

    threading.Thread(target=wait, name="signals", daemon=True).start()
