"""Detects that the launcher of a process is gone."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable


def when_launcher_is_gone(then: Callable[[], None], said: Callable[[bytes], None] = lambda _: None) -> None:
    """Call `then`, on a thread of its own, when standard input closes: the launcher holds its other end.

    said: gets every line that the launcher writes.
    """

    def wait() -> None:
        # Not sys.stdin: a thread that waits in its lock makes the interpreter abort at exit.
        rest = b""
        while read := os.read(0, 4096):
            *lines, rest = (rest + read).split(b"\n")
            for line in lines:
                said(line)
        then()

    threading.Thread(target=wait, name="launcher-watchdog", daemon=True).start()


def launcher_is_gone() -> bool:
    """Whether the other end of standard input, a pipe, is closed; asks the system, so it does not depend on a thread."""
    poll = select.poll()
    poll.register(0, 0)
    return bool(poll.poll(0))
