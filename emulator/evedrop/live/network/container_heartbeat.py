"""A file that a process touches while it is on its network: its age is a cheap health check, without asking the router.

The file is written only if the environment names it, as the image of docs/containers.md does.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import final

VARIABLE = "EVEDROP_HEARTBEAT"
_BEAT_SECONDS = 2.0


@final
class HeartbeatFile:
    """Touches the file that the environment names, if it names one, until `stop`."""

    def __init__(self, connected: Callable[[], bool], seconds: float = _BEAT_SECONDS) -> None:
        """connected: whether the process is on its network; seconds: between two checks."""
        self._connected = connected
        self._seconds = seconds
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start to touch the file. Does nothing if already started."""
        path = os.environ.get(VARIABLE)
        if path and self._thread is None:
            self._thread = threading.Thread(target=self._keep, args=(Path(path),), name="heartbeat", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop touching the file and checking the connection."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_BEAT_SECONDS)

    def _keep(self, path: Path) -> None:
        while not self._over.is_set():
            if self._connected():
                with suppress(OSError):  # the process then counts as unhealthy, but continues
                    path.touch()
            self._over.wait(self._seconds)
