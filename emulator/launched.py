"""What a process does when whoever launched it is gone."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable


def when_launcher_is_gone(then: Callable[[], None]) -> None:
    """Call `then`, on a thread of its own, when standard input closes: the launcher holds its other end."""

    def wait() -> None:
        # Not sys.stdin: a thread that waits in its lock makes the interpreter abort when it ends.
        while os.read(0, 4096):
            pass
        then()

    threading.Thread(target=wait, name="launcher-watch", daemon=True).start()


def launcher_is_gone() -> bool:
    """Whether the other end of standard input, a pipe, is closed: known at once, whichever thread is scheduled."""
    poll = select.poll()
    poll.register(0, 0)
    return bool(poll.poll(0))
