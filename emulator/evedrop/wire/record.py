"""The fate of a message on a wire, and its record: one row for each message and link, made when its fate is known.

Source: docs/wire.md, the journal.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.links.link import Fate


class WireFate(IntEnum):
    """The outcome of a message on a link. Up to `CUT` as `Fate`; the rest is not emulated but happens to the wire itself."""

    DELIVERED = Fate.DELIVERED
    """Given to Zenoh on the other side."""
    LOST = Fate.LOST
    """Erased by the link's loss model."""
    CORRUPTED = Fate.CORRUPTED
    """Damaged on the way, as a checksum would show."""
    OVERFLOW = Fate.OVERFLOW
    """The emulated queue before a link of limited rate was full."""
    CUT = Fate.CUT
    """The link was cut, or its sides were partitioned."""
    UNLINKED = 16
    """No link of the file takes its key between these sides."""
    TOO_LARGE = 17
    """Larger than `WirePlan.largest`."""
    HELD_UP = 18
    """The wire already held as many delayed messages as it may."""
    LOOPED = 19
    """A router outside the wire joins both sides, so the message would go round."""
    UNDERWAY = 20
    """Still delayed, or waiting for the wire, when it ended."""
    REFUSED = 21
    """Zenoh raised an error when the message was put on the other side."""
    TOO_MANY_KEYS = 22
    """Its key is new, and the programs of its side have already used as many keys as a wire keeps."""
    CONGESTED = 23
    """The other side no longer took messages, or too slowly, and the wire already kept as many for it as it may."""

    @property
    def emulated(self) -> bool:
        """Whether a link's settings decide this outcome."""
        return self <= WireFate.CUT

    @property
    def decided(self) -> bool:
        """Whether the loss and corruption models of a link decided on such a message, and how is known."""
        return self.passed or self in {WireFate.LOST, WireFate.CORRUPTED}

    @property
    def passed(self) -> bool:
        """Whether these models let such a message pass."""
        return self in {WireFate.DELIVERED, WireFate.HELD_UP, WireFate.UNDERWAY, WireFate.REFUSED, WireFate.CONGESTED}


class Kind(IntEnum):
    """What a message is."""

    PUT = 0
    DELETE = 1
    QUERY = 2
    REPLY = 3

    @property
    def stream(self) -> str:
        """The kind of messages with which it shares its numbers and random streams: a delete is numbered as a put."""
        return "put" if self is Kind.DELETE else self.name.lower()


AGAIN = 0x80
"""Added to the kind in the record of a message that was delivered twice."""

HELD = 0x80
"""Added to the fate in the record of a message that will be delivered, until it is: it is delayed, or waits for its turn."""

UNLINKED = 2**16 - 1
"""The code of a link in the record of a message that no link takes."""

RECORD = np.dtype(
    [
        ("time", "<f8"),  # seconds since 1970, when the wire heard it
        ("n", "<i8"),  # its number among the messages of its key and kind on its link, from 0; -1 if it has none
        ("sequence", "<i8"),  # its sender's own number for it; -1 if it has none
        ("delay", "<f8"),  # seconds that the link holds it back, its queue included
        ("key", "<u4"),  # code of the key; 0 if it is not kept, `WireFate.TOO_MANY_KEYS`
        ("source", "<u4"),  # code of the sender; 0 if it is not known
        ("size", "<u4"),  # bytes of payload and attachment
        ("link", "<u2"),  # code of the link
        ("kind", "u1"),  # `Kind`, with `AGAIN`
        ("fate", "u1"),  # `WireFate`, with `HELD`
    ]
)
"""A row of the journal while the wire runs, 48 bytes; codes of keys and sources are in another file."""


def next_numbers(block: NDArray[Any]) -> Iterator[tuple[int, int, Kind, int]]:
    """The codes of link and key, the kind, and the number after the last message, for each stream of a block of `RECORD`s."""
    rows = block[(block["n"] >= 0) & (block["link"] != UNLINKED)]
    link, key, kind = (rows[name].astype(np.uint64) for name in ("link", "key", "kind"))
    streams = link << np.uint64(40) | key << np.uint64(8) | kind & np.uint64(0x7F)
    found, places = np.unique(streams, return_inverse=True)
    numbers = np.zeros(len(found), np.int64)
    np.maximum.at(numbers, places, rows["n"] + 1)
    for stream, n in zip(found.tolist(), numbers.tolist(), strict=True):
        yield stream >> 40, stream >> 8 & 0xFFFF_FFFF, Kind(stream & 0xFF), n
