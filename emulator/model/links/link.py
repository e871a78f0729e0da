"""What a link model is: from random numbers to the fate of every packet. The router only carries fates out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from emulator.model.process import Floats
from emulator.model.receiver import Codes
from emulator.streams import Batch, BlockReader


class Fate(IntEnum):
    """What becomes of a packet on a link."""

    DELIVERED = 0
    LOST = 1
    """Erased by the link's loss model."""


def losses(fates: Codes) -> dict[str, NDArray[np.uint32]]:
    """Reason → packets lost for it in each slot, (slots,), from fates (slots, R)."""
    reasons = [reason for reason in Fate if reason is not Fate.DELIVERED]
    return {reason.name.lower(): np.asarray((fates == reason).sum(axis=1), np.uint32) for reason in reasons}


class LossModel(ABC):
    """Decides fates from uniform numbers, for all trials at once."""

    uniforms_per_slot: ClassVar[int] = 1

    @abstractmethod
    def fates(self, uniforms: Floats) -> Codes:
        """`Fate` of each packet of the next slots, (slots, R), from uniforms (slots, uniforms_per_slot, R)."""


class Link:
    """The way from the router to one receiver: a loss model and its own random stream.

    Final. Must be read in order, any number of slots at a time.
    """

    def __init__(self, loss: LossModel, key: bytes, batch: Batch) -> None:
        self._loss = loss
        self._reader = BlockReader(key, batch, loss.uniforms_per_slot)

    def fates(self, slots: range) -> Codes:
        """`Fate` of the packets of the next slots in every trial, (slots, R)."""
        return self._loss.fates(self._reader.uniforms(slots))
