"""The C library's allocator: how much memory that is free a process keeps for its next large message."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_DEFAULT = 1 << 17
_LARGEST_MMAP_THRESHOLD = 1 << 25
_MESSAGES = 8  # copies of a message that exist at a time: packed, with its key, in Zenoh's queues


def keep_for_messages(largest: int) -> None:
    """Keep free memory for messages of up to `largest` bytes, instead of returning it to the system after each.

    By default the GNU C library returns each block of more than 128 KiB, and the system clears every page of the next one: for
    a message of 1 MB this takes several times as long as packing it. Other C libraries do as they like.
    """
    if largest * _MESSAGES <= _DEFAULT:
        return
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, min(2 * largest, _LARGEST_MMAP_THRESHOLD))
        library.mallopt(_TRIM_THRESHOLD, min(_MESSAGES * largest, 2**30))
