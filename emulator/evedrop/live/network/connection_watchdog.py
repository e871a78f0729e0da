"""A process that has had no connection with its router for too long ends itself: the recorder cannot tell it to end."""

from __future__ import annotations

import os
import sys
import threading
from typing import final

from evedrop.errors import RunError
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.last_word import Cause, LastWord
from evedrop.system.output import say


@final
class ConnectionWatchdog:
    """Ends its process after `flow.longest_outage` without a connection."""

    def __init__(self, brief: AnyBrief) -> None:
        self._brief = brief
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._released = False

    def changed(self, connected: bool) -> None:
        """Handle the loss or the return of the connection."""
        self._set(lost=not connected)

    def release(self) -> None:
        """Stop watching: the process closes its connection itself."""
        self._released = True
        self._set(lost=False)

    def _set(self, lost: bool) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = None
            if lost and not self._released:
                self._timer = threading.Timer(self._brief.flow.longest_outage, self._give_up)
                self._timer.daemon = True
                self._timer.start()

    def _give_up(self) -> None:
        sentence = (
            f"{self._brief.process} has had no connection with the router at {self._brief.router} for "
            f"{self._brief.flow.longest_outage:g} s; check that the router runs and can be reached"
        )
        say(sentence)
        sys.stderr.flush()
        LastWord(Cause.NO_CONNECTION, sentence).leave(self._brief.last_word)
        os._exit(RunError.exit_status)
