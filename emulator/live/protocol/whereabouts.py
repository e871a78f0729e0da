"""Where a process is: at which slot, and on whose messages it waits. It says so when the observer asks, and not before.

A process that is connected and does nothing cannot be told from one that waits for it but by asking all of them.

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
    """What a process says of itself."""

    slot: int
    """The slot that it is at."""
    waits: tuple[str, ...]
    """The keys on which it waits for a message; none while it does not wait."""

    def pack(self) -> bytes:
        """As a message."""
        return pack({"k": self.slot, "waits": list(self.waits)})


def is_whereabouts(message: Reader) -> bool:
    """Whether telemetry, or the journal, says where a process is."""
    return message.has("waits")


def read_whereabouts(message: Reader, slots: int) -> Whereabouts:
    """Where a process of a run of so many slots is."""
    waits = message.names("waits")
    if len(waits) > _MOST_KEYS:
        raise message.malformed(f"{len(waits)} keys in waits", f"{_MOST_KEYS} at most")
    return Whereabouts(message.integer("k", 0, slots), waits)


@final
class Place:
    """Kept by a process as it works, and read by the thread that answers."""

    def __init__(self) -> None:
        self.slot = 0
        """The slot that it is at."""
        self.waits: tuple[str, ...] = ()
        """As in `Whereabouts`."""
        self._asked: SimpleQueue[None] = SimpleQueue()

    @contextmanager
    def waiting(self, *keys: str) -> Iterator[None]:
        """While the process waits on these keys."""
        self.waits = keys
        try:
            yield
        finally:
            self.waits = ()

    def ask(self) -> None:
        """The observer asks."""
        self._asked.put(None)

    def answer(self, put: Callable[[bytes], None]) -> None:
        """Answer from now on, on a thread of its own."""

        def go_on() -> None:
            while True:
                self._asked.get()
                put(Whereabouts(self.slot, self.waits).pack())

        threading.Thread(target=go_on, name="whereabouts", daemon=True).start()
