"""Signal handlers for the start of a command, installed before any slow import.

Ctrl-C, SIGTERM and SIGHUP end a command with status 130 at any moment. At first the command exits at once; when it has begun
work that must be ended in order, `evedrop.system.signals` takes over.
"""

from __future__ import annotations

# The C module under `signal`: `signal` imports enum and more, which takes about as long as the interpreter needs to start.
import _signal as signal  # type: ignore[import-not-found]
import os

# Not from typing, whose import would take longer than everything before it; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

INTERRUPTED = 130
"""The exit status of an interrupted command."""
SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The signals that interrupt a command."""


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
