"""The measurements of some slots of a batch of trials in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from evedrop.model.process import Floats
from evedrop.model.receiver import Codes
from evedrop.model.slot.link import Fates
from evedrop.score.slots import Slots


@dataclass(frozen=True)
class ReceiverChunk:
    """One receiver over c slots of R trials."""

    error: Floats
    """The error of the mode, (c, R)."""
    trace: Floats
    """Believed tr P, (c, R)."""
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
