"""The process that a program runs in: its id, its end, the signals that it gets, its standard files.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import NoReturn, Protocol, TextIO, cast, final

from evedrop.system.allocator import keep_for_messages
from evedrop.system.guard import dismiss, guard_of
from evedrop.system.native_log import native_log_apart
from evedrop.system.output import Output
from evedrop.system.parents import continue_when_parent_dies
from evedrop.system.signals import (
    SHOW_STACKS,
    heeded,
    leave_on_signals,
    raise_on_signals,
    stop_on_signals,
    stop_or_leave_on_signals,
    told_when_suspended,
)
from evedrop.system.threads import ThreadEvent

_SWITCH_SECONDS = 5e-4
"""How long a thread may keep the interpreter while another one waits for it."""


class ThisProcess(Protocol):
    """What a program can do to its own process, and ask about it."""

    @property
    def pid(self) -> int:
        """Its id."""

    def exit(self, status: int) -> NoReturn:
        """End it at once: no handler runs, and nothing is flushed."""

    def interrupt(self) -> None:
        """Send it SIGTERM."""

    def on_signals(self, handle: Callable[[], object]) -> None:
        """Call this at Ctrl-C, SIGTERM and SIGHUP, unless they are ignored from the start."""

    def leave_on_signals(self) -> None:
        """Let these signals end it at once, with status 130."""

    def stop_on_signals(self) -> AbstractContextManager[ThreadEvent]:
        """An event that these signals set while the block runs."""

    def stop_or_leave_on_signals(self, leave: Callable[[], object]) -> AbstractContextManager[ThreadEvent]:
        """An event that the first of these signals sets while the block runs; a second one calls `leave`, which exits."""

    def raise_on_signals(self) -> AbstractContextManager[None]:
        """Let the first of these signals raise KeyboardInterrupt on the thread of the block, while it runs."""

    def on_thread_failure(self, handle: Callable[[BaseException], object]) -> None:
        """Call this, on the thread, when an error ends a thread other than the first."""

    def told_when_suspended(self, tell: Callable[[], object]) -> AbstractContextManager[None]:
        """Call `tell` before Ctrl-Z suspends it while the block runs."""

    def removed_with_it(self, folder: Path) -> AbstractContextManager[None]:
        """Have a folder, which is made in the block, removed after it, or should this process die, however it dies.

        Raises OSError.
        """

    def switch_threads_soon(self) -> None:
        """Let a thread that computes for long give way to others much sooner than by Python's default."""

    def prepare_for_messages(self, largest: int) -> None:
        """Keep memory for messages of up to `largest` bytes, and modules."""

    def keep_modules(self) -> None:
        """Let no collection of garbage look at imported modules."""

    def keep_files_private(self) -> None:
        """Let only this user read the files that it makes from now on."""

    def show_stacks(self) -> None:
        """Write the stack of every thread to standard error upon `SHOW_STACKS`, even while native code holds Python's lock."""

    def continue_when_parent_dies(self) -> None:
        """Let the system continue it if it is suspended when its parent dies: it would not notice."""

    def native_log_apart(self) -> AbstractContextManager[None]:
        """While the block runs, pass what native code prints on to standard error, escaped and up to a limit."""

    def read_input(self, most: int) -> bytes:
        """Wait for what comes on standard input; empty at its end."""

    def input_closed(self) -> bool:
        """Whether nothing more can come there: the other end of the pipe is closed."""

    def keep_events_apart(self, launched: bool) -> None:
        """Redirect standard output to standard error: Zenoh logs to it, and would mix its lines into the events.

        launched: whether a launcher reads the events, from the former standard output; `print` then writes to the log.
        """

    def send_event(self, line: bytes) -> None:
        """Send a line to the launcher, or to standard output without one. Raises OSError or ValueError if nobody reads it."""


@final
class RealProcess(ThisProcess):
    """The process of this interpreter. Blocks that handle signals have no effect outside the main thread."""

    leave_on_signals = staticmethod(leave_on_signals)
    stop_on_signals = staticmethod(stop_on_signals)
    stop_or_leave_on_signals = staticmethod(stop_or_leave_on_signals)
    raise_on_signals = staticmethod(raise_on_signals)
    told_when_suspended = staticmethod(told_when_suspended)
    continue_when_parent_dies = staticmethod(continue_when_parent_dies)
    native_log_apart = staticmethod(native_log_apart)

    def __init__(self) -> None:
        self._line = threading.Lock()  # one line at a time
        self._events: TextIO | None = None
        """The stream for a launched process's events; None before `keep_events_apart`, and if it was started by hand."""

    @property
    def pid(self) -> int:
        """Its id."""
        return os.getpid()

    def exit(self, status: int) -> NoReturn:
        """End it at once."""
        os._exit(status)

    def interrupt(self) -> None:
        """Send it SIGTERM."""
        os.kill(os.getpid(), signal.SIGTERM)

    def on_signals(self, handle: Callable[[], object]) -> None:
        """Call this at the signals that interrupt a command."""
        for number in heeded():
            signal.signal(number, lambda *_: handle())

    def on_thread_failure(self, handle: Callable[[BaseException], object]) -> None:
        """Call this when an error ends a thread."""

        def hook(failure: threading.ExceptHookArgs) -> None:
            if failure.exc_value is not None and not isinstance(failure.exc_value, SystemExit):
                handle(failure.exc_value)

        threading.excepthook = hook

    @contextmanager
    def removed_with_it(self, folder: Path) -> Iterator[None]:
        """Start a shell that holds the other end of a pipe to this process; dismiss it after the block."""
        guard = guard_of(folder)
        try:
            yield
        finally:
            dismiss(guard)

    def switch_threads_soon(self) -> None:
        """By Python's default a message waits for 5 ms for such a thread."""
        sys.setswitchinterval(_SWITCH_SECONDS)

    def prepare_for_messages(self, largest: int) -> None:
        """Keep memory, and modules: a collection that looks at them holds up packets."""
        keep_for_messages(largest)
        self.keep_modules()

    def keep_modules(self) -> None:
        """Nor at anything else that there is."""
        gc.freeze()

    def keep_files_private(self) -> None:
        """Set the mask of the modes of files."""
        os.umask(0o077)

    def show_stacks(self) -> None:
        """Write the stack of every thread to standard error upon `SHOW_STACKS`."""
        faulthandler.register(SHOW_STACKS, all_threads=True)

    def read_input(self, most: int) -> bytes:
        """Wait for what comes on standard input."""
        # Not sys.stdin: a thread that waits in its lock makes the interpreter abort at exit.
        return os.read(0, most)

    def input_closed(self) -> bool:
        """Ask the system, so that the answer depends on no thread."""
        poll = select.poll()
        poll.register(0, 0)
        return bool(poll.poll(0))

    def keep_events_apart(self, launched: bool) -> None:
        """Redirect file descriptor 1 to standard error."""
        sys.stdout.flush()
        apart = os.fdopen(os.dup(1), "w", encoding="utf-8")
        os.dup2(2, 1)
        if launched:
            self._events = apart
        else:
            sys.stdout = cast(TextIO, Output(apart))

    def send_event(self, line: bytes) -> None:
        """Write a line to where events go."""
        left = memoryview(line)
        with self._line, suppress(AttributeError):  # there is no standard output
            to = (self._events or sys.stdout).fileno()
            while left:
                left = left[os.write(to, left) :]


REAL_PROCESS: ThisProcess = RealProcess()
