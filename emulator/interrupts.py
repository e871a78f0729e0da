"""What a signal does to a command, settled before anything that takes time is imported.

Ctrl-C, SIGTERM and SIGHUP end a command with status 130 at any moment. Until a command has begun something that must be ended
in order, it ends at once; then `evedrop.signals` takes over.
"""

from __future__ import annotations

# What `signal` wraps, for that imports enum and more, which takes about as long as the interpreter needs to start.
import _signal as signal  # type: ignore[import-not-found]
import os

# Not from typing, whose import would take longer than everything before it; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

INTERRUPTED = 130
"""The exit status of what was interrupted."""
SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What interrupts a command."""


def heeded() -> list[int]:
    """Those that are not ignored: nohup ignores SIGHUP, and a shell SIGINT for a job in the background."""
    return [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]


def leave(_number: int, _frame: FrameType | None) -> NoReturn:
    """End this process at once, since nothing has begun."""
    os._exit(INTERRUPTED)


def heed_signals() -> None:
    """End at once at a signal, until something else is said; also at one that came while the interpreter started."""
    for number in heeded():
        signal.signal(number, leave)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)  # whoever launched us may have blocked them
