"""The words of notes: what the parts of the simulated world write down as it happens, for the hash of a run and to be shown.

A note has one of these words, and others that say more. They begin with the process that it is about, except for those of PUT,
which is about the process whose thread goes on, and of FAULT.

Source: docs/maintainers/simulated-world.md, a failing seed.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import msgpack

STARTS = "starts"
"""Process."""
ENDS = "ends"
"""Process, exit status."""
SUSPENDED = "is suspended"
"""Process."""
GOES_ON = "goes on"
"""Process."""
SIGNAL = "signal"
"""Process, number of the signal."""
FAULT = "fault"
"""What a case does to the run, as a text."""
PUT = "put"
"""Key (`key_within`), bytes of the message, what the message says (`said_in`). After it, the number of events so far
(`VirtualScheduler.events`) names the message."""
GETS = "gets"
"""Process, key, number of the message that has arrived at it."""
LOST = "lost"
"""Process, key, number of the message that will never arrive at it, why."""
NO_ROOM = "no room"
"""Why it was lost: its connection was full, and it does not wait."""
CONNECTS = "connects"
"""Process, to which router."""
DISCONNECTS = "disconnects"
"""Process, from which router, why: "cut", "closed", "router is gone"."""
FREEZES = "freezes"
"""Process, router: nothing gets through between them."""
WRITES = "changes"
"""Process, what it does to a file (writes, renames, …), name of the file."""


BY_HAND = "by hand"
"""The last words in the name of a process that is not the run's: somebody has started it beside the run."""


def key_within(key: str) -> str:
    """A run's key without the run: `evedrop/RUN/control/sensor` is `control/sensor`; any other key as it is."""
    parts = key.split("/", 2)
    return parts[2] if len(parts) > 2 and parts[0] == "evedrop" else key


def said_in(message: bytes) -> str:
    """The command or the slots that a message carries, in few words: "end", "12", "0-27", "hold 28", "leaves 5"; or nothing.

    message: as it is put, with its envelope.
    """
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(message)
    try:
        unpacker.skip()
        fields = unpacker.unpack()
    except (ValueError, TypeError, msgpack.UnpackException):  # a stranger's, or a shortened one
        return ""
    if not isinstance(fields, dict):
        return ""
    first, slots = fields.get("k"), fields.get("c", 1)
    words = (
        [str(fields["do"])]
        if "do" in fields
        else [word for word in ("hold", "again", "over", "leaves") if word in fields]
    )
    if isinstance(first, int) and isinstance(slots, int):
        words.append(f"{first}-{first + slots - 1}" if slots > 1 else str(first))
    return " ".join(words)


def came_as(key: str) -> str:
    """Why a message was lost: it arrived as one of another key."""
    return f"came as {key}"


_SLOTS = re.compile(r"(\d+)(?:-(\d+))?")


class PutMessage(NamedTuple):
    """A message that somebody has put."""

    at: float
    """Virtual seconds."""
    key: str
    said: str
    """As `said_in` says it."""

    @property
    def slots(self) -> range:
        """Those that it is of; empty for a command, or a barrier."""
        match = _SLOTS.fullmatch(self.said)
        return range(0) if match is None else range(int(match[1]), int(match[2] or match[1]) + 1)
