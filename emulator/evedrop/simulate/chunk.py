"""The measurements of some slots of a batch of trials in memory, and counts of the packets that the sensor sent in each trial.

The energy and the bits of a scheme follow from the counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes, Flags
from evedrop.model.slot.link import Fates
from evedrop.score.slots import Slots


@dataclass(frozen=True)
class ReceiverChunk:
    """One receiver over c slots of R trials."""

    error: Floats
    """The error of the mode, (c, R)."""
    trace: Floats
    """Reported tr P, (c, R)."""
    action: Codes
    """(c, R)."""
    fates: Fates
    """Fates of the packets sent in these slots, (c, R)."""


@dataclass(frozen=True)
class Chunk:
    """The measurements of some slots."""

    first: int
    receivers: Mapping[str, ReceiverChunk]
    slots: Slots | None = None
    """In exact mode, all that a scorekeeper needs of the slots except what is counted over trials."""


@final
@dataclass
class PacketTally:
    """Counts over the slots of R trials."""

    sent: NDArray[np.int64]
    """Packets, (R,)."""
    encrypted: NDArray[np.int64]
    """Those among them that were encrypted, (R,)."""

    @classmethod
    def zero(cls, trials: int) -> PacketTally:
        """No packets yet."""
        return cls(np.zeros(trials, np.int64), np.zeros(trials, np.int64))

    @classmethod
    def merged(cls, parts: Sequence[PacketTally]) -> PacketTally:
        """The counts of several sets of trials, at least one, in order."""
        return cls(
            np.concatenate([tally.sent for tally in parts]), np.concatenate([tally.encrypted for tally in parts])
        )

    def add_slots(self, encrypted: Flags, sent: Flags | None) -> None:
        """Add some slots: whether each packet is encrypted, and whether it is sent, (c, R) each; None: all are sent."""
        if sent is None:
            self.sent += len(encrypted)
        else:
            self.sent += np.count_nonzero(sent, axis=0)
            encrypted = encrypted & sent
        self.encrypted += np.count_nonzero(encrypted, axis=0)

    def add_counts(self, other: PacketTally) -> None:
        """Add the counts of further slots of the same trials."""
        self.sent += other.sent
        self.encrypted += other.encrypted

    def part(self, trials: slice) -> PacketTally:
        """The counts of some of the trials."""
        return PacketTally(self.sent[trials], self.encrypted[trials])
