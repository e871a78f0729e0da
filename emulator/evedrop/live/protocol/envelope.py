"""The envelope: every message begins with the full key it was put on, and a reader drops messages that name another key.

Zenoh may deliver one key's messages to another key's subscriber after connections flap (docs/upstream.md). Only the message
itself shows this: the sample shows the key of the subscriber.

Source: docs/protocol.md, envelope.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import final

import msgpack

_SHOWN_BYTES = 600  # more than any key of a run has


def head_of(key: str) -> bytes:
    """The beginning of every message on a key: the key as a msgpack string."""
    head: bytes = msgpack.packb(key)
    return head


def enclosed(key: str, payload: bytes) -> bytes:
    """The message that carries a payload on a key."""
    return head_of(key) + payload


def payload_of(key: str, message: bytes) -> bytes | None:
    """The payload of a message that arrived on a key; None if it names another key."""
    head = head_of(key)
    return message[len(head) :] if message.startswith(head) else None


def named_in(message: bytes) -> str | None:
    """The key that a message names, or None."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(message[:_SHOWN_BYTES])
    try:
        found = unpacker.unpack()
    except Exception:  # msgpack raises various errors for bytes that are not a message
        return None
    return found if isinstance(found, str) else None


@final
class Dropped:
    """Counts the messages that a process dropped because they name another key than they arrived on; thread-safe.

    mistaken: called when a message names another key, which means that the connection confuses keys.
    """

    def __init__(self, process: str, mistaken: Callable[[], None] = lambda: None) -> None:
        self._process, self._mistaken = process, mistaken
        self._lock = threading.Lock()
        self.count = 0

    def add(self, key: str, message: bytes) -> None:
        """Count a dropped message; report the first, the tenth, the hundredth and so on, on standard error."""
        with self._lock:
            self.count += 1
            number = self.count
        named = named_in(message)
        if number == 10 ** (len(str(number)) - 1):
            what = f"names {named}" if named is not None else "names no key"
            sys.stderr.write(
                f"evedrop: {self._process}: dropped a message that came on {key} and {what} (number {number}); "
                "if it was needed, it is sent again\n"
            )
            sys.stderr.flush()
        if named is not None:
            self._mistaken()

    def contents(self, key: str, head: bytes, message: bytes) -> bytes | None:
        """The payload of a message that arrived on a key with that head; None if it names another key and was dropped."""
        if message.startswith(head):
            return message[len(head) :]
        self.add(key, message)
        return None
