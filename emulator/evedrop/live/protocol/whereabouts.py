"""A process's report, on request, of the slot that it is at and of the keys on which it waits for messages.

Only by asking all processes can the observer tell a connected process that does nothing from those that wait for it.

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
class Whereabouts:
    """A process's report of where it is."""

    slot: int
    """The slot that it is at."""
    waits: tuple[str, ...]
    """The keys on which it waits for a message; empty if it does not wait."""

    def pack(self) -> bytes:
        """Encode it as a message."""
        return pack({"k": self.slot, "waits": list(self.waits)})


def is_whereabouts(message: Reader) -> bool:
    """Whether a message on telemetry or journal is a process's whereabouts."""
    return message.has("waits")


def read_whereabouts(message: Reader, slots: int) -> Whereabouts:
    """Decode a process's whereabouts; slots: of the run."""
    waits = message.names("waits")
    if len(waits) > _MOST_KEYS:
        raise message.malformed(f"{len(waits)} keys in waits", f"{_MOST_KEYS} at most")
    return Whereabouts(message.integer("k", 0, slots), waits)


@final
class Place:
    """Where a process is: updated by the working thread, read by the answering thread."""

    def __init__(self) -> None:
        self.slot = 0
        """The slot that it is at."""
        self.waits: tuple[str, ...] = ()
        """As in `Whereabouts`."""
        self._asked: SimpleQueue[None] = SimpleQueue()

    @contextmanager
    def waiting(self, *keys: str) -> Iterator[None]:
        """Record that the process waits on these keys during the block."""
        self.waits = keys
        try:
            yield
        finally:
            self.waits = ()

    def ask(self) -> None:
        """Take a question from the observer."""
        self._asked.put(None)

    def answer(self, put: Callable[[bytes], None]) -> None:
        """Start a thread that answers the questions; put: sends an answer."""

        def go_on() -> None:
            while True:
                self._asked.get()
                put(Whereabouts(self.slot, self.waits).pack())

        threading.Thread(target=go_on, name="whereabouts", daemon=True).start()
