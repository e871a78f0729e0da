"""Waits for the ends of threads, always with a limit."""

from __future__ import annotations

import threading

from evedrop.errors import RunError

THREAD_SECONDS = 600.0
"""How long to wait for a thread that was told to end. It ends within seconds, unless something that it calls hangs."""


def wait_for_thread(thread: threading.Thread, seconds: float = THREAD_SECONDS) -> None:
    """Wait until a thread has ended. Raises RunError if it still runs after `seconds`."""
    if thread.ident is None:  # it was never started, as on a machine that lacks threads: the reason is told elsewhere
        return
    thread.join(seconds)
    if thread.is_alive():
        raise RunError(
            f"the thread {thread.name} was told to end {seconds:g} s ago and still runs, because something that it called has "
            "hung; report this"
        )
