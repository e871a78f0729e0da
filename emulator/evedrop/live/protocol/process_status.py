"""A process's report, on request, of the slot that it is at and of the keys on which it waits for messages.

Only by asking all processes can the recorder tell a connected process that does nothing from those that wait for it.

Source: docs/protocol.md, silence.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import final

from evedrop.live.protocol.codec import Reader, pack

_MOST_KEYS = 4096


@dataclass(frozen=True)
class ProcessStatus:
    """What a process reports of itself."""

    slot: int
    """The slot that it is at."""
    waits: tuple[str, ...]
    """The keys on which it waits for a message; empty if it does not wait."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"k": self.slot, "waits": list(self.waits)})


def is_process_status(message: Reader) -> bool:
    """Whether a message on telemetry or journal is a process's status."""
    return message.has("waits")


def read_process_status(message: Reader, slots: int) -> ProcessStatus:
    """Decode a process's status; slots: of the run."""
    waits = message.names("waits")
    if len(waits) > _MOST_KEYS:
        raise message.malformed(f"{len(waits)} keys in waits", f"{_MOST_KEYS} at most")
    return ProcessStatus(message.integer("k", 0, slots), waits)


@final
class StatusReporter:
    """Reports the status of its process: the working thread updates it, another thread answers requests."""

    def __init__(self) -> None:
        self.slot = 0
        """The slot that it is at."""
        self.waits: tuple[str, ...] = ()
        """As in `ProcessStatus`."""
        self._requests: SimpleQueue[None] = SimpleQueue()

    @contextmanager
    def waiting(self, *keys: str) -> Iterator[None]:
        """Record that the process waits on these keys during the block."""
        self.waits = keys
        try:
            yield
        finally:
            self.waits = ()

    def request(self) -> None:
        """Take a request from the recorder."""
        self._requests.put(None)

    def answer(self, put: Callable[[bytes], None]) -> None:
        """Start a thread that answers the requests; put: sends an answer."""

        def go_on() -> None:
            while True:
                self._requests.get()
                put(ProcessStatus(self.slot, self.waits).pack())

        threading.Thread(target=go_on, name="status", daemon=True).start()
