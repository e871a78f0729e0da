"""A file that a process touches as long as it is on its network: its age says so to whoever cannot afford to ask the router.

Written only where the environment names it, as the image of docs/containers.md does.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

VARIABLE = "EVEDROP_HEARTBEAT"
_BEAT_SECONDS = 2.0


class HeartbeatFile:
    """Touches the file of the environment, if there is one, until `stop`. Final."""

    def __init__(self, connected: Callable[[], bool], seconds: float = _BEAT_SECONDS) -> None:
        """connected: whether the process is on its network; seconds: between two looks."""
        self._connected = connected
        self._seconds = seconds
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Touch it from now on. Harmless if it has begun."""
        path = os.environ.get(VARIABLE)
        if path and self._thread is None:
            self._thread = threading.Thread(target=self._keep, args=(Path(path),), name="heartbeat", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Touch it no more, and look at the connection no more."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_BEAT_SECONDS)

    def _keep(self, path: Path) -> None:
        while not self._over.is_set():
            if self._connected():
                with suppress(OSError):  # then the process is said to be unhealthy, and goes on
                    path.touch()
            self._over.wait(self._seconds)
